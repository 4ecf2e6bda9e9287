"""Slow changes of the illumination over the frame, told from the object by its motion.

A vignette is a gain that changes slowly from core to core. The scene follows such a gain nearly all the way, so what is
left of it shows only where cores that lie apart have seen one place: with r the ratio of a sample to the scene that was
solved from it, less 1, S the logarithm of the shading at core n, and a the exposure of frame t,

    r_tn = S(x_n) + log a_t - E(T_t x_n) + noise

E is how far the scene follows: any value in each small cell of the scene, with the mean slope of S within it. It is
eliminated, which leaves a least-squares problem of some hundred unknowns: S is a cubic B-spline over the frame, one for
each channel. Without its slope within cells, E would seem to tell the slope of S, which only exposures that hardly vary
can tell.

How strongly curvature and slope of S, and the exposures, are held back is what makes the ratios most likely (MacKay,
"Bayesian interpolation", Neural Computation 4(3), 1992). So a burst that tells nothing of the shading, because it is
even or hardly moves, gets none; and neither does one whose shading might be chance.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from threadpoolctl import threadpool_limits
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.displacement import ControlGrid
from napari_fiberburst.motion.linearised import huber
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.scene.prediction import predict
from napari_fiberburst.scene.solve import solve_quickly

# Intervals between control points along the longer side of the frame.
_INTERVALS = 6
# In pitches: between the nodes of the scene that samples are compared with, and the side of a cell in which that scene
# may have any error.
_SPACING, _CELL = 0.3, 0.5
_SMOOTHNESS = 0.03
# The scene is solved anew after each round, and outliers are found anew in each pass.
_ROUNDS, _PASSES = 2, 3
# Rounds in which the strengths of the priors settle.
_STRENGTH_ROUNDS = 10
# A sample counts where the scene shows it at least this part of the frame's mean light.
_LEAST_LIGHT_OF_MEAN = 0.1
# Bundles in nearly even light have slopes of the shading (logarithm, middle to edge) and relative changes of exposure
# of about this size; smaller ones are not asked for.
_USUAL_SLOPE, _LEAST_SLOPE = 0.02, 0.01
_USUAL_FLICKER, _LEAST_FLICKER = 3e-3, 3e-4
# Of the logarithm, from control point to control point.
_USUAL_CURVATURE, _LEAST_CURVATURE = 0.1, 1e-4
_LEAST_STRENGTH = 0.1
# The constant of the shading, which nothing tells, is held by this.
_RIDGE = 1e-4
# In variances of the noise: by so much, and so much for each degree of freedom, a shading must reduce the squares.
_LEAST_GAIN = (4.0, 2.0)
# Shadings that are this even everywhere (ratio of the brightest to the darkest place, less 1) change nothing.
_LEAST_SHADING = 0.02
# Matrices over cells are dense, because products of sparse ones take several times as long; so many rows at once.
_CELLS_AT_ONCE = 2**15
# What the mean frame shows is smoothed by this weight of its curvature, for a core to each.
_FRAME_CURVATURE = 1.0

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shading:
    """How brightly cores are lit, beyond what is known of the bundle.

    Attributes
    ----------
    gains : Tensor
        (G, C) each core's, with the median 1 in each channel.
    exposures : Tensor
        (T,) what the frames' exposures are to be multiplied by.
    """

    gains: Tensor
    exposures: Tensor

    @property
    def is_noticeable(self) -> bool:
        """Whether it differs over the frame at all."""
        return bool((self.gains.amax(dim=0) / self.gains.amin(dim=0)).amax() > 1 + _LEAST_SHADING)

    def times(self, other: "Shading") -> "Shading":
        """Return both together."""
        return Shading(gains=self.gains * other.gains, exposures=self.exposures * other.exposures)

    def exposed(self, registration: Registration) -> Registration:
        """Return the registration with the exposures that belong to samples in even light."""
        exposures = registration.exposures * self.exposures.cpu().numpy()
        return replace(registration, exposures=exposures.astype(np.float32))


def find_shading(samples: Samples, registration: Registration) -> Shading | None:
    """Find how the illumination changes over the frame, as far as the motion tells it.

    Parameters
    ----------
    samples : Samples
        Of whole cores, in all channels, as they were taken.
    registration : Registration
        Where they lie, and what gains to take out of them.

    Returns
    -------
    Shading or None
        None where nothing is to be told: the object does not move, there is no bundle, or the light is even.
    """
    if registration.is_still or samples.gain_variance == 0:
        return None
    found = Shading(
        gains=torch.ones(samples.cores, samples.values.shape[2]).to(samples.values),
        exposures=torch.ones(len(samples.values)).to(samples.values),
    )
    # By one thread, because BLAS rounds its products differently by each number of threads.
    with threadpool_limits(limits=1, user_api="blas"):
        for _ in range(_ROUNDS):
            left = _find_what_is_left(samples.without_gains(found.gains), found.exposed(registration))
            if left is None:
                break
            found = found.times(left)
    return found if found.is_noticeable else None


def shading_of_frames(samples: Samples) -> Shading:
    """Return the slow changes of the mean frame as if all of them were the illumination's.

    Parameters
    ----------
    samples : Samples
        Of whole cores, in all channels.
    """
    basis = _Basis.over(samples)
    weights = samples.weights.cpu().double().numpy()
    total = (weights[..., None] * samples.values.cpu().double().numpy()).sum(axis=0)
    light = total / np.maximum(weights.sum(axis=0), 1e-9)[:, None]
    floor = _LEAST_LIGHT_OF_MEAN * light.mean(axis=0)
    seen = (weights.sum(axis=0) > 0).astype(np.float64)
    matrix = (basis.splines.T @ sparse.diags(seen) @ basis.splines).toarray()
    matrix += _FRAME_CURVATURE * basis.curvature + _RIDGE * np.eye(len(matrix))
    control = np.linalg.solve(matrix, basis.splines.T @ (seen[:, None] * np.log(np.maximum(light, floor))))
    return _shading(basis, control.T, np.zeros(len(weights)), samples)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Basis:
    """The B-spline over the frame.

    Attributes
    ----------
    splines : scipy.sparse.csr_matrix
        (N, M), from control points to samples.
    slopes : numpy.ndarray
        (2, M), from control points to the mean slope along x and y, per pixel.
    curvature : numpy.ndarray
        (M, M), matrix of the energy of curvature, summed over control points.
    reach : float
        From the middle of the frame to its edge, pixels.
    """

    splines: Any
    slopes: Array
    curvature: Array
    reach: float

    @classmethod
    def over(cls, samples: Samples) -> "_Basis":
        """Cover the frame."""
        longest = max(samples.shape)
        grid = ControlGrid.over(samples.shape, longest / _INTERVALS)
        index, weight = grid.splines(samples.positions.cpu().double())
        first = np.arange(len(index) + 1) * index.shape[1]
        size = (len(index), grid.shape[0] * grid.shape[1])
        splines = sparse.csr_matrix((weight.flatten().numpy(), index.flatten().numpy(), first), shape=size)
        places = np.indices(grid.shape).reshape(2, -1)[::-1] * grid.spacing
        places = places - places.mean(axis=1, keepdims=True)
        slopes = places / (places**2).sum(axis=1, keepdims=True)
        return cls(splines=splines, slopes=slopes, curvature=_curvature(grid.shape), reach=longest / 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Ratios:
    """Samples relative to the scene that was solved from them.

    Attributes
    ----------
    values, weights : numpy.ndarray
        (T, N, C) the ratio less 1, and how much it counts.
    cells : numpy.ndarray
        (T, N) number of the cell of the scene.
    within : numpy.ndarray
        (T, N, 2) where in its cell, (x, y) from the middle, pixels.
    order, first : numpy.ndarray
        (T * N,) the samples cell by cell, and where in it each cell begins, and the last one ends.
    """

    values: Array
    weights: Array
    cells: NDArray[np.int64]
    within: Array
    order: NDArray[np.intp]
    first: NDArray[np.intp]

    def over_cells(self, values: Array, columns: NDArray[np.intp]) -> Any:
        """Return the sparse sums of values (T, N) over cells (rows) and something else."""
        entries = (values.ravel()[self.order], columns[self.order], self.first)
        return sparse.csr_matrix(entries, shape=(len(self.first) - 1, int(columns.max()) + 1))

    def without_means(self, values: Array, weights: Array) -> Array:
        """Return values (T, N) of one channel without their weighted mean in each cell."""
        cells = self.cells.ravel()
        mass = np.maximum(np.bincount(cells, weights.ravel()), 1e-12)
        means = np.bincount(cells, (weights * values).ravel()) / mass
        left: Array = values - means[self.cells]
        return left


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _System:
    """Normal equations in the control points of all channels, then the log exposures, of noise of variance 1."""

    matrix: Array
    rhs: Array

    def of_noise(self, variance: float) -> "_System":
        """Return the equations were the noise of this variance."""
        return _System(matrix=self.matrix / variance, rhs=self.rhs / variance)


def _find_what_is_left(samples: Samples, registration: Registration) -> Shading | None:
    """Find the shading by one scene; None where it does not stand out of the noise."""
    ratios, basis = _compare(samples, registration), _Basis.over(samples)
    known = np.where(registration.used, np.log(registration.exposures.astype(np.float64)), 0.0)
    priors = _Priors.usual(basis, samples.values.shape[2], known)
    robust = np.ones_like(ratios.weights)
    solution = np.zeros(len(priors.matrices[0]))
    for _ in range(_PASSES):
        weights = ratios.weights * robust
        left = _left(ratios, weights, basis, solution)
        channels = _channels(ratios, weights, basis)
        system = _normal_equations(channels, left)
        found, settled = priors.settled(system)
        if not settled.stands_out(system, found):
            return None  # most bursts: they end here after one pass
        system = system.of_noise(_excess(channels, left))
        solution, priors = priors.settled(system)
        if not priors.stands_out(system, solution):
            return None
        left = _left(ratios, weights, basis, solution)
        sizes = torch.from_numpy(left * np.sqrt(ratios.weights))
        robust = huber(sizes, torch.from_numpy(ratios.weights)).numpy()
    frames = len(known)
    return _shading(basis, solution[:-frames].reshape(-1, basis.splines.shape[1]), solution[-frames:], samples)


def _shading(basis: _Basis, control: Array, log_exposures: Array, samples: Samples) -> Shading:
    """Return the shading of control points (C, M)."""
    logs = basis.splines @ control.T
    logs = torch.from_numpy(logs - np.median(logs, axis=0))
    return Shading(
        gains=logs.exp().to(samples.values), exposures=torch.from_numpy(np.exp(log_exposures)).to(samples.values)
    )


def _compare(samples: Samples, registration: Registration) -> _Ratios:
    """Solve a scene, and compare the samples with it."""
    points = registration.points(samples.positions)
    grid = Grid.around(points, _SPACING * samples.pitch, 2 * samples.pitch)
    scene = solve_quickly(samples, registration, grid, _SMOOTHNESS)
    values, weights = (np.zeros(tuple(samples.values.shape)) for _ in range(2))
    for part in predict(scene.samples, points, grid, scene.filtered):
        floor = _LEAST_LIGHT_OF_MEAN * part.light.mean(dim=0)
        ratio = part.values / torch.maximum(part.light, floor).clamp_min(1e-9) - 1
        usable = (part.light > floor) & (ratio.abs() < 1) & (part.weights > 0)[:, None]
        weight = part.weights[:, None] * part.light**2
        values[part.frame] = torch.where(usable, ratio, torch.zeros_like(ratio)).cpu().numpy()
        weights[part.frame] = torch.where(usable, weight, torch.zeros_like(weight)).cpu().numpy()
    places = torch.nan_to_num(points).cpu() / (_CELL * samples.pitch)
    within = (places - places.floor() - 0.5) * (_CELL * samples.pitch)
    places = (places.floor() - places.floor().amin(dim=(0, 1))).long()
    number = places[..., 1] * (places[..., 0].max() + 1) + places[..., 0]
    cells = torch.unique(number, return_inverse=True)[1].numpy()
    return _Ratios(
        values=values,
        weights=weights,
        cells=cells,
        within=within.double().numpy(),
        order=np.argsort(cells, axis=None, kind="stable"),
        first=np.append(0, np.bincount(cells.ravel()).cumsum()),
    )


def _left(ratios: _Ratios, weights: Array, basis: _Basis, solution: Array) -> Array:
    """Return what a solution leaves of the ratios, (T, N, C)."""
    frames, _, channels = ratios.values.shape
    control = solution[:-frames].reshape(channels, -1)
    shading = (basis.splines @ control.T)[None] - ratios.within @ (basis.slopes @ control.T)
    left = ratios.values - shading - solution[-frames:, None, None]
    return np.stack(
        [ratios.without_means(left[..., channel], weights[..., channel]) for channel in range(channels)], axis=-1
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Channel:
    """What one channel adds to the normal equations.

    Attributes
    ----------
    ratios : _Ratios
        Of all channels.
    values, weights : numpy.ndarray
        (T, N) of this one.
    basis : _Basis
        Of its shading.
    """

    ratios: _Ratios
    values: Array
    weights: Array
    basis: _Basis

    def equations(self) -> tuple[Array, Array]:
        """Return matrix and right-hand side in the M control points, then the T log exposures.

        Slopes within cells are unknowns of their own at first, which then follow from the control points.
        """
        frames, controls = len(self.values), self.basis.splines.shape[1]
        matrix, rhs = self._of_regressors()
        expand = np.zeros((len(rhs), controls + frames))
        expand[:controls, :controls] = np.eye(controls)
        expand[controls : controls + 2, :controls] = -self.basis.slopes
        expand[controls + 2 :, controls:] = np.eye(frames)
        return expand.T @ matrix @ expand, expand.T @ rhs

    def excess(self, left: Array) -> tuple[float, float]:
        """Return how much more the gradient of a core's, and of a cell's, residuals (T, N) varies than if independent.

        In parts of their mean weighted square.
        """
        splines, (cores, _) = self.basis.splines, self._columns()
        dense, mass, missed = splines.toarray(), self._mass(), self.weights * left
        weights, misfit = (self.ratios.over_cells(part, cores) for part in (self.weights, missed))
        in_cells = self._sum_over_cells(missed)
        of_cores = missed.sum(axis=0)[:, None] * dense
        power, by_cell = float((self.weights.sum(axis=0) @ splines.multiply(splines)).sum()), 0.0
        for rows in _blocks(len(mass)):
            means = (weights[rows] @ dense) / mass[rows, None]
            of_cores -= misfit[rows].T @ means
            by_cell += float(np.square(misfit[rows] @ dense - in_cells[rows, None] * means).sum())
            power -= float((mass[rows] @ means**2).sum())
        square = float((self.weights * left**2).sum()) / max(int((self.weights > 0).sum()), 1)
        expected = max(square * power, 1e-30)
        return float(np.square(of_cores).sum()) / expected, by_cell / expected

    def _of_regressors(self) -> tuple[Array, Array]:
        """Return matrix and right-hand side in control points, slopes within cells (2) and log exposures."""
        splines, within, w = self.basis.splines, self.ratios.within, self.weights
        cores, times = self._columns()
        moments, light = w[..., None] * within, w * self.values
        first, last = slice(splines.shape[1]), slice(splines.shape[1] + 2, None)
        middle = slice(first.stop, last.start)
        dense, scale = splines.toarray(), 1 / np.sqrt(self._mass())
        of_cores, of_times = (self.ratios.over_cells(w, columns) for columns in (cores, times))
        of_slopes = np.stack([self._sum_over_cells(part) for part in np.moveaxis(moments, -1, 0)], axis=1)
        of_light = self._sum_over_cells(light)
        size = dense.shape[1] + 2 + len(w)
        matrix, rhs = np.zeros((size, size)), np.zeros(size)
        for cells in _blocks(len(scale)):
            own = np.hstack([of_cores[cells] @ dense, of_slopes[cells], of_times[cells].toarray()])
            own *= scale[cells, None]
            matrix -= own.T @ own
            rhs -= own.T @ (scale * of_light)[cells]
        for rows, columns, part in (
            (first, first, (splines.T @ sparse.diags(w.sum(axis=0)) @ splines).toarray()),
            (first, middle, splines.T @ moments.sum(axis=0)),
            (first, last, splines.T @ w.T),
            (middle, middle, np.einsum("tni,tnj->ij", moments, within)),
            (middle, last, moments.sum(axis=1).T),
            (last, last, np.diag(w.sum(axis=1))),
        ):
            matrix[rows, columns] += part
            if rows != columns:
                matrix[columns, rows] += part.T
        whole = [splines.T @ light.sum(axis=0), np.einsum("tni,tn->i", within, light), light.sum(axis=1)]
        return matrix, rhs + np.concatenate(whole)

    def _columns(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the number of the core, and of the frame, of each sample, (T * N,)."""
        frames, count = self.values.shape
        return np.tile(np.arange(count), frames), np.repeat(np.arange(frames), count)

    def _sum_over_cells(self, values: Array) -> Array:
        return np.bincount(self.ratios.cells.ravel(), values.ravel()).astype(np.float64)

    def _mass(self) -> Array:
        return np.maximum(self._sum_over_cells(self.weights), 1e-12)


def _blocks(count: int) -> list[slice]:
    """Return the rows of cells that are taken at once."""
    return [slice(first, first + _CELLS_AT_ONCE) for first in range(0, count, _CELLS_AT_ONCE)]


def _channels(ratios: _Ratios, weights: Array, basis: _Basis) -> list[_Channel]:
    """Return the channels of ratios with other weights (T, N, C)."""
    return [
        _Channel(ratios=ratios, values=values, weights=own, basis=basis)
        for values, own in zip(np.moveaxis(ratios.values, 2, 0), np.moveaxis(weights, 2, 0), strict=True)
    ]


def _normal_equations(channels: list[_Channel], left: Array) -> _System:
    """Set up the normal equations, divided by the variance of the noise, as if all ratios were independent.

    The variance is that of what the last solution has left, (T, N, C), with one degree of freedom less for each cell.
    """
    frames, controls = len(left), channels[0].basis.splines.shape[1]
    size = len(channels) * controls + frames
    matrix, rhs = np.zeros((size, size)), np.zeros(size)
    free, squares = 0, 0.0
    for number, channel in enumerate(channels):
        own, own_rhs = channel.equations()
        at = np.r_[number * controls : (number + 1) * controls, len(channels) * controls : size]
        matrix[np.ix_(at, at)] += own
        rhs[at] += own_rhs
        counted = channel.weights > 0
        free += int(counted.sum()) - int(np.count_nonzero(np.bincount(channel.ratios.cells[counted])))
        squares += float((channel.weights * left[..., number] ** 2).sum())
    return _System(matrix=matrix, rhs=rhs).of_noise(max(squares / max(free, 1), 1e-12))


def _excess(channels: list[_Channel], left: Array) -> float:
    """Return by how much the variance is larger because ratios of one core, and of one cell, are wrong alike.

    They tell less than as many independent ones; only a shading that would stand out of those is worth the asking.
    """
    return max(1.0, *(part for number, channel in enumerate(channels) for part in channel.excess(left[..., number])))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Priors:
    """Three Gaussian priors about zero, of strengths that the data set: of curvature, slopes and exposures.

    Attributes
    ----------
    matrices : tuple of numpy.ndarray
        Of each prior's energy.
    ranks : tuple of int
        Of the matrices.
    strengths : tuple of float
        One over each prior's variance.
    known : numpy.ndarray
        (T,) logarithms of the exposures that the solution's are added to; the prior is on the sum.
    """

    matrices: tuple[Array, ...]
    ranks: tuple[int, ...]
    strengths: tuple[float, ...]
    known: Array

    @classmethod
    def usual(cls, basis: _Basis, channels: int, known: Array) -> "_Priors":
        """Return the priors of usual strengths."""
        frames, controls = len(known), len(basis.curvature)
        size = channels * controls + frames
        curvature, slope, exposures = (np.zeros((size, size)) for _ in range(3))
        curvature[:-frames, :-frames] = np.kron(np.eye(channels), basis.curvature)
        slopes = basis.reach * basis.slopes
        slope[:-frames, :-frames] = np.kron(np.eye(channels), slopes.T @ slopes)
        exposures[-frames:, -frames:] = np.eye(frames)
        return cls(
            matrices=(curvature, slope, exposures),
            ranks=(channels * (controls - 3), channels * 2, frames),
            strengths=tuple(size**-2 for size in (_USUAL_CURVATURE, _USUAL_SLOPE, _USUAL_FLICKER)),
            known=known,
        )

    def settled(self, system: _System) -> tuple[Array, "_Priors"]:
        """Return the solution, and the priors of the strengths at which the data are most likely."""
        strengths = self.strengths
        most = tuple(size**-2 for size in (_LEAST_CURVATURE, _LEAST_SLOPE, _LEAST_FLICKER))
        frames = len(self.known)
        offset = np.concatenate([np.zeros(len(system.rhs) - frames), self.known])
        for _ in range(_STRENGTH_ROUNDS):
            covariance = self._covariance(system, strengths)
            solution = covariance @ (system.rhs - strengths[-1] * offset)
            strengths = tuple(
                float(np.clip(told / _energy(part, solution + offset), _LEAST_STRENGTH, top))
                for told, part, top in zip(self._told(covariance, strengths), self.matrices, most, strict=True)
            )
        return solution, replace(self, strengths=strengths)

    def stands_out(self, system: _System, solution: Array) -> bool:
        """Whether the shading makes the ratios more likely by more than its degrees of freedom would by chance."""
        curvature, slope, _ = self._told(self._covariance(system, self.strengths), self.strengths)
        shading = solution.copy()
        shading[-len(self.known) :] = 0
        gained = 2 * float(shading @ system.rhs) - float(shading @ system.matrix @ shading)
        return gained > _LEAST_GAIN[0] + _LEAST_GAIN[1] * (curvature + slope)

    def _covariance(self, system: _System, strengths: tuple[float, ...]) -> Array:
        """Return the covariance of the solution under priors of these strengths."""
        prior = sum(strength * part for strength, part in zip(strengths, self.matrices, strict=True))
        return np.asarray(np.linalg.inv(system.matrix + prior + _RIDGE * np.eye(len(system.rhs))), dtype=np.float64)

    def _told(self, covariance: Array, strengths: tuple[float, ...]) -> list[float]:
        """Return how many degrees of freedom of each prior the data tell."""
        return [
            rank - strength * float(np.vdot(covariance, part))
            for rank, strength, part in zip(self.ranks, strengths, self.matrices, strict=True)
        ]


def _energy(matrix: Array, values: Array) -> float:
    """Return x' P x, never 0."""
    return max(float(values @ matrix @ values), 1e-12)


def _curvature(shape: tuple[int, int]) -> Array:
    """Return the matrix of the sum of squared second differences over control points, 0 for any plane."""
    number = np.eye(shape[0] * shape[1]).reshape(*shape, -1)
    down, across = np.diff(number, 2, axis=0), np.diff(number, 2, axis=1)
    mixed = np.diff(np.diff(number, axis=0), axis=1)
    rows = [part.reshape(-1, part.shape[-1]) for part in (down, across, np.sqrt(2) * mixed)]
    differences = np.concatenate(rows)
    energy: Array = differences.T @ differences
    return energy
