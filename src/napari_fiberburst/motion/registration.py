"""Step 2: register the frames of a burst by its samples, from a coarse search to hundredths of a pixel."""

import logging
from collections.abc import Generator
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.coordinates import relative_to, transform_points
from napari_fiberburst.motion.coarse import LEAST_CONFIDENCE, confidence, find_shifts
from napari_fiberburst.motion.displacement import ControlGrid, Displacement
from napari_fiberburst.motion.joint import enter, iterate, normalise, predict, start
from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.motion.problem import (
    BENDING,
    COARSE,
    CONTROL_SPACING,
    FINE_CORES,
    FINE_PIXELS,
    FINER,
    JointProblem,
    JointState,
    Level,
)
from napari_fiberburst.motion.score import bending_score
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.steps import drain
from napari_fiberburst.stored import Stored

logger = logging.getLogger(__name__)

# The motion has a handful of unknowns a frame, so this many samples of it are plenty,
_MOST_SAMPLES = 500_000
# and the first iterations, which only bring rotation and perspective into reach, need fewer.
_COARSE_SAMPLES = 60_000
# Root mean square over the corners, in pitches: frames that move less do not fill the gaps between cores.
_LEAST_MOTION = 0.25
# A frame that agrees with the others less than this part of the median frame is left out.
_LEAST_OF_USUAL = 0.6
# A frame whose area grows or shrinks by more than this factor, or that leaves by more than its own size, is lost.
_MOST_SWELLING = 3.0
# Pixels: iterations at a level end where no frame's centre moves farther than this.
_ENOUGH = 0.015
# Frames may bend where their residuals ask for it by the first score, or by the second and leave more unexplained than
# this; and do where that leaves at most this part of the residuals.
_CLEAR_SCORE, _SCORE, _UNEXPLAINED_BY_PLANES, _MOST_LEFT_BY_BENDING = 3.0, 1.6, 0.14, 0.9
# A registration that leaves more unexplained than this has failed, or the model is wrong. Of simulated bursts those
# that are registered to some tenths of a pixel leave up to 0.2 without noise, and those that are not 0.26 and more.
MOST_UNEXPLAINED = 0.22
# Of full scale: the mean light that values are divided by, at least.
_LEAST_LIGHT = 1e-4

Stage = Literal["none", "shifts", "coarse", "fine", "complete"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GreyScene:
    """The scene as registration sees it, in grey.

    Attributes
    ----------
    grid : Grid
        Its nodes, in scene pixels.
    nodes : Tensor
        (H, W), relative to `light`.
    light : float
        The mean light of the samples, full scale 1.
    """

    grid: Grid
    nodes: Tensor
    light: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration(Stored):
    """Where every frame of a burst looks, and how far to trust it.

    Attributes
    ----------
    scene_from_frame : numpy.ndarray
        (T, 3, 3) float64, frame-t pixel (x, y) to scene pixel.
    shape : (int, int)
        Height and width of a frame.
    used : numpy.ndarray
        (T,) bool, frames that take part. The others could not be registered.
    confidence : numpy.ndarray
        (T,) 0 to 1, how well each frame agrees with the others where they overlap; NaN while that is not known.
    frame_weights : numpy.ndarray
        (T,) 0 to 1, how much each frame counts: blurred ones fit worse, and count less.
    gains : numpy.ndarray
        (G,) float32, gain of each core relative to what the samples assume; 1 where none was looked for.
    exposures : numpy.ndarray
        (T,) float32, brightness of each frame relative to the others: their geometric mean is 1, of frames that take
        part.
    residual : float
        Root of the weighted mean square of what the model leaves of the samples, full scale 1; NaN before the first
        iteration.
    travel : float
        How far the frames' corners lie from where they are on average, root mean square, pixels; NaN while that is not
        known.
    unexplained : float
        Part of the samples' change from frame to frame that the model does not explain, as a ratio of root mean squares
        without the noise, 0 to 1; NaN while that is not known. It is below 0.2 where the registration has succeeded.
    is_still : bool
        Whether the object moves too little to fill the gaps between cores.
    stage : str
        How far it has come: "none", "shifts", "coarse", "fine" (shear and perspective too), or "complete".
    iterations : int
        Gauss-Newton iterations done.
    notes : tuple of str
        What a user should know.
    scene : GreyScene or None
        The scene that the frames were registered to.
    displacement : Displacement or None
        How frames bend beyond their homographies; None where they were not asked to.
    """

    _kind: ClassVar[str] = "registration"

    scene_from_frame: NDArray[np.float64]
    shape: tuple[int, int]
    used: NDArray[np.bool_]
    confidence: NDArray[np.float64]
    frame_weights: NDArray[np.float32]
    gains: NDArray[np.float32]
    exposures: NDArray[np.float32]
    residual: float = float("nan")
    travel: float = float("nan")
    unexplained: float = float("nan")
    is_still: bool = False
    stage: Stage = "none"
    iterations: int = 0
    notes: tuple[str, ...] = ()
    scene: GreyScene | None = field(default=None, repr=False)
    displacement: Displacement | None = field(default=None, repr=False)

    @classmethod
    def known(cls, scene_from_frame: NDArray[np.float64], shape: tuple[int, int], cores: int) -> "Registration":
        """Return a registration for motion (T, 3, 3) that is known, such as a simulation's."""
        count = len(scene_from_frame)
        return cls(
            scene_from_frame=np.array(scene_from_frame, dtype=np.float64),
            shape=shape,
            used=np.ones(count, dtype=bool),
            confidence=np.ones(count),
            frame_weights=np.ones(count, np.float32),
            gains=np.ones(cores, np.float32),
            exposures=np.ones(count, np.float32),
            stage="complete",
        )

    @property
    def reference(self) -> int:
        """The first frame that takes part: images and homographies are in its pixels."""
        return int(np.flatnonzero(self.used)[0])

    @property
    def reference_from_frame(self) -> NDArray[np.float64]:
        """(T, 3, 3), frame-t pixel to the reference frame's pixel; NaN for frames that are left out."""
        relative = relative_to(self.scene_from_frame, self.reference)
        relative[~self.used] = np.nan
        return relative

    def points(self, positions: Tensor) -> Tensor:
        """Return where places (N, 2) of every frame lie in the reference frame's pixels, (T, N, 2); NaN if left out."""
        if self.displacement is None:
            points: Tensor = transform_points(torch.from_numpy(self.reference_from_frame).to(positions), positions)
            return points
        points = self.motion.to_reference(self.motion.apply(positions), self.reference)
        return torch.where(torch.from_numpy(self.used).to(points.device)[:, None, None], points, torch.nan)

    @property
    def motion(self) -> FrameMotion:
        """Frame pixels to scene pixels, as an operator on points."""
        return FrameMotion(torch.from_numpy(self.scene_from_frame), self.shape, self.displacement)

    def as_recorded(self, offsets: NDArray[np.float64]) -> "Registration":
        """Return the registration of the frames as they were before each was moved back by its offset.

        Parameters
        ----------
        offsets : numpy.ndarray
            (T, 2), pixels: what was at pixel x of a frame as registered had been recorded at x + offset. That of the
            reference frame is 0.
        """
        moved = self.scene_from_frame @ FrameMotion.of_shifts(-offsets, self.shape).scene_from_frame.numpy()
        displacement = None if self.displacement is None else self.displacement.moved(torch.from_numpy(offsets))
        return replace(self, scene_from_frame=moved, displacement=displacement)

    def correct(self, samples: Samples) -> Samples:
        """Return samples at gains and exposures of 1, and weighed by how far each frame is to be trusted.

        Parameters
        ----------
        samples : Samples
            Of the frames that were registered, by the bundle as it was before.
        """
        gains, exposures = (torch.from_numpy(part).to(samples.values) for part in (self.gains, self.exposures))
        frame_weights = torch.from_numpy(self.frame_weights)
        return samples.without_gains(gains).without_exposures(exposures).weighted(frame_weights)

    def predicted(self, number: int, pixels: Tensor) -> Tensor:
        """Return the grey light of the scene at pixels (N, 2) of frame `number`, as exposed; 0 where unknown."""
        if self.scene is None or not self.used[number]:
            return torch.zeros(len(pixels)).to(pixels)
        sampling = self.scene.grid.at(self.motion.of_frame(number).apply(pixels)[0])
        return sampling(self.scene.nodes) * (self.scene.light * float(self.exposures[number]))


def register(
    samples: Samples,
    *,
    dof: int = 8,
    bends: bool | None = None,
    noise: float = 0.0,
    iterations: int | None = None,
    seed: int = 0,
) -> Registration:
    """Find how every frame lies on the scene.

    Parameters
    ----------
    samples : Samples
        Of whole cores, grey or in colour.
    dof : int
        Degrees of freedom of each frame's motion: 2 for a translation, 4 for a similarity, 6 for an affine transform, 8
        for a homography; 0 where the frames are known not to move.
    bends : bool, optional
        Whether frames bend beyond that; None lets the residuals tell.
    noise : float
        Standard deviation that noise gives to a typical sample, full scale 1; 0 where it is not known.
    iterations : int, optional
        Gauss-Newton iterations at most.
    seed : int
        The first iterations use some of the samples, drawn by this seed.

    Returns
    -------
    Registration
        Frames that do not belong are marked in `used`, and named in `notes`.
    """
    return drain(registering(samples, dof=dof, bends=bends, noise=noise, iterations=iterations, seed=seed))


def refine(
    samples: Samples, registration: Registration, *, dof: int = 8, iterations: int | None = None, seed: int = 0
) -> Registration:
    """Refine a registration to some hundredths of a pixel, with the footprint of the samples in the model.

    Parameters
    ----------
    samples : Samples
        Of cores or of pixels, by a bundle that was measured again after the frames were registered.
    registration : Registration
        By `register`. One whose object does not move is returned as it is.
    dof, seed
        As for `register`.
    iterations : int, optional
        Gauss-Newton iterations at most, those of `registration` included.

    Returns
    -------
    Registration
        With the gains relative to what the samples assume.
    """
    return drain(refining(samples, registration, dof=dof, iterations=iterations, seed=seed))


def unregistered(samples: Samples) -> Registration:
    """Return the registration before anything is known: all frames lie on one another."""
    count = len(samples.values)
    return Registration(
        scene_from_frame=np.tile(np.eye(3), (count, 1, 1)),
        shape=samples.shape,
        used=np.ones(count, dtype=bool),
        confidence=np.full(count, np.nan),
        frame_weights=np.ones(count, np.float32),
        gains=np.ones(samples.cores, np.float32),
        exposures=np.ones(count, np.float32),
    )


def registering(
    samples: Samples, *, dof: int, bends: bool | None, noise: float, iterations: int | None, seed: int
) -> Generator[Registration, None, Registration]:
    """Register as `register` does; yields what is known after each iteration."""
    start = unregistered(samples)
    if len(samples.values) < 2:
        return _alone(start, samples)
    if dof == 0:
        judged = _judged(start, samples)
        return _still(judged) if judged.used.sum() > 1 else _alone(judged, samples)
    shifts = find_shifts(samples.positions, samples.grey, samples.weights, samples.shape, samples.pitch)
    found = replace(
        start,
        used=shifts.connected,
        confidence=shifts.confidence,
        frame_weights=shifts.connected.astype(np.float32),
        stage="shifts",
    )
    moved = shifts.shifts - shifts.shifts[found.reference]
    moved[~found.used] = 0
    found = replace(found, scene_from_frame=FrameMotion.of_shifts(moved, samples.shape).scene_from_frame.numpy())
    yield found
    if found.used.sum() < 2:
        return _alone(found, samples)
    search = _Search(samples=samples, dof=dof, shifts=moved, noise=noise, iterations=iterations, seed=seed)
    found = yield from search.refine(replace(found, stage="coarse"), (COARSE,), None, _COARSE_SAMPLES)
    found = replace(found, stage="fine")
    yield found
    found = yield from search.refine(found, FINER, None, None)
    if bends or (bends is None and search.asks_to_bend(found)):
        bent = yield from search.refine(_bendable(found, samples), BENDING, None, None)
        found = bent if bends or bent.residual < _MOST_LEFT_BY_BENDING * found.residual else found
    found = _judged(replace(found, unexplained=_unexplained(found, samples, noise)), samples)
    if found.used.sum() < 2:
        return _alone(found, samples)
    return _still(found) if found.is_still else replace(found, stage="complete")


def refining(
    samples: Samples, found: Registration, *, dof: int, iterations: int | None, seed: int
) -> Generator[Registration, None, Registration]:
    """Refine a registration, and find the gains, by the final samples of the bundle; yields after each iteration.

    Parameters
    ----------
    samples : Samples
        Of cores, with their footprint, or of pixels.
    found : Registration
        By `register`; its frames lie on the same scene.
    dof, seed
        As for `register`.
    iterations : int, optional
        Gauss-Newton iterations at most, those that `found` has had included.
    """
    if found.scene is None or found.is_still:
        return found
    shifts = found.scene_from_frame[:, :2, 2].copy()
    search = _Search(samples=samples, dof=dof, shifts=shifts, noise=0.0, iterations=iterations, seed=seed)
    levels, most = (FINE_PIXELS, _MOST_SAMPLES) if samples.kind == "pixels" else (FINE_CORES, None)
    return (yield from search.refine(found, levels, samples.radius, most))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Search:
    """Gauss-Newton iterations from where the frames lie."""

    samples: Samples
    dof: int
    shifts: NDArray[np.float64]
    noise: float
    iterations: int | None
    seed: int

    def refine(
        self, found: Registration, levels: tuple[Level, ...], radius: float | None, most: int | None
    ) -> Generator[Registration, None, Registration]:
        """Refine by at most so many samples, seen through a footprint of this radius; yields after each iteration."""
        light = _light(self.samples, found) if found.scene is None else found.scene.light
        problem = self._problem(found, light, most)
        state = start(problem, found.motion) if found.scene is None else self._resumed(found, found.scene, problem)
        for level in levels:
            level = replace(level, bends=found.displacement is not None)
            if self._is_spent(found):
                break
            state = enter(problem, state, level, radius)
            for number in range(level.iterations):
                before = state.motion
                state, farthest = iterate(problem, state, level, number)
                lost = state.motion.has_left(self.shifts, _MOST_SWELLING)
                if lost.any():
                    state = replace(state, motion=state.motion.where(~lost, before))
                    if (found.used & ~lost).any():
                        found = replace(found, used=found.used & ~lost)
                        problem = problem.without(torch.from_numpy(lost))
                found = self._registered(replace(found, iterations=found.iterations + 1), problem, state, light)
                yield found
                if self._is_spent(found) or (farthest < _ENOUGH and number > 0):
                    break
            state = normalise(problem, state)
        weights = _frame_weights(problem, state, found.used)
        return replace(self._registered(found, problem, state, light), frame_weights=weights)

    def _resumed(self, found: Registration, scene: GreyScene, problem: JointProblem) -> JointState:
        """Return the state where an earlier search has left off."""
        gains = torch.from_numpy(found.gains).to(scene.nodes)
        return JointState(
            motion=found.motion,
            grid=scene.grid,
            scene=scene.nodes,
            gains=gains,
            exposures=torch.from_numpy(found.exposures).to(gains),
        )

    def asks_to_bend(self, found: Registration) -> bool:
        """Whether what is left of rigid frames has the structure that displacements leave."""
        if found.scene is None or self._is_spent(found):
            return False
        unexplained = _unexplained(found, self.samples, self.noise)
        if unexplained > MOST_UNEXPLAINED:
            return True
        problem = self._problem(found, found.scene.light, None)
        score = bending_score(problem, self._resumed(found, found.scene, problem))
        return score > (_SCORE if unexplained > _UNEXPLAINED_BY_PLANES else _CLEAR_SCORE)

    def _is_spent(self, found: Registration) -> bool:
        return self.iterations is not None and found.iterations >= self.iterations

    def _problem(self, found: Registration, light: float, most: int | None) -> JointProblem:
        """Return the problem of the samples, or of so many of them that are drawn from all."""
        samples, device = self.samples.weighted(torch.from_numpy(found.used)), self.samples.positions.device
        chosen = torch.arange(len(samples.positions), device=device)
        if most is not None:
            wanted = max(1, most // int(found.used.sum()))
            generator = torch.Generator().manual_seed(self.seed)
            chosen = torch.randperm(len(samples.positions), generator=generator)[:wanted].sort().values.to(device)
        return JointProblem(
            positions=samples.positions[chosen],
            values=samples.values[:, chosen].mean(dim=2) / light,
            weights=samples.weights[:, chosen],
            core_index=samples.core_index[chosen],
            cores=samples.cores,
            pitch=samples.pitch,
            dof=self.dof,
            gains_fixed=samples.gains_known,
            controls=None if found.displacement is None else found.displacement.grid.at(samples.positions[chosen]),
        )

    def _registered(self, found: Registration, problem: JointProblem, state: JointState, light: float) -> Registration:
        """Return what is known now."""
        is_every_core_asked = self.samples.kind == "pixels" or len(problem.positions) == len(self.samples.positions)
        return replace(
            found,
            scene_from_frame=state.motion.scene_from_frame.numpy().copy(),
            displacement=state.motion.displacement,
            gains=state.gains.cpu().numpy() if is_every_core_asked else found.gains,
            exposures=state.exposures.cpu().numpy(),
            residual=state.residual * light,
            scene=GreyScene(grid=state.grid, nodes=state.scene, light=light),
        )


def _bendable(found: Registration, samples: Samples) -> Registration:
    """Return the registration with frames that may bend, and do not yet."""
    grid = ControlGrid.over(samples.shape, CONTROL_SPACING * samples.pitch)
    return replace(found, displacement=Displacement.none(len(found.used), grid, samples.positions.device))


def _light(samples: Samples, found: Registration) -> float:
    """Return the mean light of the samples of frames that take part, full scale 1."""
    samples = samples.weighted(torch.from_numpy(found.used))
    mass = samples.weights.sum().clamp_min(1e-9)
    return max(float((samples.grey * samples.weights).sum() / mass), _LEAST_LIGHT)


def _frame_weights(problem: JointProblem, state: JointState, used: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return how much each frame should count, (T,), by how well it fits the scene: a blurred one fits worse."""
    left = (problem.values - predict(problem, state)).square() * problem.weights
    error = (left.sum(dim=1) / problem.weights.sum(dim=1).clamp_min(1e-9)).cpu().numpy()
    usual = np.median(error[used])
    weights: NDArray[np.float32] = (used * np.clip(usual / np.maximum(error, 1e-12), 0, 1)).astype(np.float32)
    return weights


def _evened(found: Registration, samples: Samples) -> Tensor:
    """Return grey values at gains and exposures of 1, (T, N)."""
    gains, exposures = (torch.from_numpy(part).to(samples.values) for part in (found.gains, found.exposures))
    return samples.grey / (exposures[:, None] * gains[samples.core_index])


def _unexplained(found: Registration, samples: Samples, noise: float) -> float:
    """Return what part of the samples' change from frame to frame is left, as a ratio of root mean squares."""
    samples = samples.weighted(torch.from_numpy(found.used))
    values, weights = _evened(found, samples), samples.weights
    mean = (weights * values).sum(dim=0) / weights.sum(dim=0).clamp_min(1e-9)
    change = float((weights * (values - mean).square()).sum() / weights.sum().clamp_min(1e-9))
    left = max(found.residual**2 - noise**2, 0.0)
    return float(np.sqrt(left / max(change - noise**2, left, 1e-12)))


def _judged(found: Registration, samples: Samples) -> Registration:
    """Ask how far each frame is to be trusted, leave out those that are not, and see whether they move at all."""
    samples = samples.weighted(torch.from_numpy(found.used))
    agreement = confidence(samples.positions, _evened(found, samples), samples.weights, found.motion, samples.pitch)
    trust = np.where(found.used, np.clip(agreement, 0, 1), 0.0)
    used = found.used & (trust >= max(LEAST_CONFIDENCE, _LEAST_OF_USUAL * np.median(trust[found.used])))
    judged = replace(found, used=used, confidence=trust, frame_weights=used.astype(np.float32))
    if used.sum() < 2:
        return judged
    if not used.all():
        left_out = ", ".join(str(number) for number in np.flatnonzero(~used))
        judged = _noted(judged, f"frames that could not be registered are left out: {left_out}")
    travel = _travel(judged.reference_from_frame[used], samples.shape)
    return replace(judged, travel=travel, is_still=bool(travel < _LEAST_MOTION * samples.pitch))


def _still(found: Registration) -> Registration:
    """Return a registration whose frames all look at the same place."""
    return replace(found, is_still=True, stage="complete", gains=np.ones_like(found.gains))


def _alone(found: Registration, samples: Samples) -> Registration:
    """Return a registration of one frame: that of median brightness, which is neither black nor over-exposed."""
    if len(found.used) > 1:
        found = _noted(
            found, "the frames could not be registered to one another; the image is made of one of them alone"
        )
    brightness = samples.grey.mean(dim=1).cpu().numpy()
    used = np.arange(len(found.used)) == int(np.argsort(brightness)[len(brightness) // 2])
    return _still(replace(found, used=used, frame_weights=used.astype(np.float32)))


def _travel(homographies: NDArray[np.float64], shape: tuple[int, int]) -> float:
    """Return how far the frames' corners lie from where they are on average, root mean square, pixels."""
    height, width = shape
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], dtype=np.float64)
    places = transform_points(homographies, corners)
    return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=2).mean()))


def _noted(found: Registration, text: str) -> Registration:
    logger.warning(text)
    return replace(found, notes=(*found.notes, text))
