"""Step 2: register the frames of a burst by its samples, from a coarse search to hundredths of a pixel."""

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.approach import scales, smoothed, uneven_light
from napari_fiberburst.motion.coarse import find_shifts
from napari_fiberburst.motion.displacement import ControlGrid, Displacement
from napari_fiberburst.motion.freedom import restrict
from napari_fiberburst.motion.gain_prior import with_told_prior
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
from napari_fiberburst.motion.registration import GreyScene, Registration, unregistered
from napari_fiberburst.motion.score import bending_score
from napari_fiberburst.motion.trust import MOST_UNEXPLAINED, alone, judged, still, unexplained_part
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.steps import drain

# The motion has a handful of unknowns a frame, so this many samples of it are plenty,
_MOST_SAMPLES = 500_000
# and the first iterations, which only bring rotation and perspective into reach, need fewer.
_COARSE_SAMPLES = 60_000
# A frame whose area grows or shrinks by more than this factor, or that leaves by more than its own size, is lost.
_MOST_SWELLING = 3.0
# Pixels: iterations at a level end where no frame's centre moves farther than this.
_ENOUGH = 0.015
# Frames may bend where their residuals ask for it by the first score, or by the second and leave more unexplained than
# this; and do where that leaves at most this part of the residuals. Where the registration has failed, by the third:
# what wrong gains leave has less structure than noise (0.2 to 0.3), and what far bending leaves has more.
_CLEAR_SCORE, _SCORE, _UNEXPLAINED_BY_PLANES, _MOST_LEFT_BY_BENDING = 3.0, 1.6, 0.14, 0.9
_SCORE_OF_FAILURE = 0.4
# Degrees of freedom of a homography.
_MOST_FREEDOM = 8
# Of full scale: the mean light that values are divided by, at least.
_LEAST_LIGHT = 1e-4


def register(
    samples: Samples,
    *,
    dof: int | None = None,
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
    dof : int, optional
        Degrees of freedom of each frame's motion: 2 for a translation, 4 for a similarity, 6 for an affine transform, 8
        for a homography; 0 where the frames are known not to move. None takes as few as explain it.
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
    samples: Samples,
    registration: Registration,
    *,
    dof: int | None = None,
    iterations: int | None = None,
    seed: int = 0,
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


def registering(
    samples: Samples,
    *,
    dof: int | None,
    bends: bool | None,
    noise: float,
    iterations: int | None,
    seed: int,
    places: NDArray[np.intp] | None = None,
) -> Generator[Registration, None, Registration]:
    """Register as `register` does, with the places (T,) of a bundle that moves; yields after each iteration."""
    start = replace(unregistered(samples), dof=_MOST_FREEDOM if dof is None else dof)
    if len(samples.values) < 2:
        return alone(start, samples)
    if dof == 0:
        found = judged(start, samples)
        return still(found) if found.used.sum() > 1 else alone(found, samples)
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
        return alone(found, samples)
    search = _Search(samples=samples, shifts=moved, noise=noise, iterations=iterations, seed=seed, places=places)
    found = replace(found, stage="coarse")
    light = uneven_light(samples)
    even = samples.without_gains(light)
    for spacing, levels in scales(samples.shape, samples.pitch):
        coarser = replace(search, samples=smoothed(even, spacing))
        found = yield from coarser.refine(found, levels, None, _COARSE_SAMPLES)
    found = yield from replace(search, samples=even).refine(found, (COARSE,), None, _COARSE_SAMPLES)
    found = replace(found, stage="fine", gains=light.cpu().numpy())
    yield found
    found = yield from search.refine(found, FINER, None, None)
    if bends or (bends is None and search.asks_to_bend(found)):
        bent = yield from search.refine(_bendable(found, samples), BENDING, None, None)
        found = bent if bends or _unbiased_residual(bent, samples) < _MOST_LEFT_BY_BENDING * found.residual else found
    found = judged(replace(found, unexplained=unexplained_part(found, samples, noise)), samples)
    if found.used.sum() < 2:
        return alone(found, samples)
    return still(found) if found.is_still else replace(found, stage="complete")


def refining(
    samples: Samples,
    found: Registration,
    *,
    dof: int | None,
    iterations: int | None,
    seed: int,
    places: NDArray[np.intp] | None = None,
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
    places : numpy.ndarray, optional
        (T,), the place that the bundle has in each frame, where it moves on the camera.
    """
    if found.scene is None or found.is_still:
        return found
    shifts = found.scene_from_frame[:, :2, 2].copy()
    search = _Search(samples=samples, shifts=shifts, noise=0.0, iterations=iterations, seed=seed, places=places)
    levels, most = (FINE_PIXELS, _MOST_SAMPLES) if samples.kind == "pixels" else (FINE_CORES, None)
    found = yield from search.refine(found, levels, samples.radius, most)
    return search.restricted(found, most) if dof is None and found.displacement is None else found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Search:
    """Gauss-Newton iterations from where the frames lie."""

    samples: Samples
    shifts: NDArray[np.float64]
    noise: float
    iterations: int | None
    seed: int
    places: NDArray[np.intp] | None

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
            if found.scene is not None and self.samples.gains_known and problem.gain_variance > 0:
                problem = with_told_prior(problem, state)
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
        unexplained = unexplained_part(found, self.samples, self.noise)
        problem = self._problem(found, found.scene.light, None)
        score = bending_score(problem, self._resumed(found, found.scene, problem))
        if unexplained > MOST_UNEXPLAINED:
            return score > _SCORE_OF_FAILURE
        return score > (_SCORE if unexplained > _UNEXPLAINED_BY_PLANES else _CLEAR_SCORE)

    def restricted(self, found: Registration, most: int | None) -> Registration:
        """Return a registration by the samples' footprint within the smallest model of motion that explains it."""
        if found.scene is None or self._is_spent(found):
            return found
        problem = self._problem(found, found.scene.light, most)
        state = self._resumed(found, found.scene, problem)
        if self.samples.radius is not None:
            state = replace(state, footprint=Footprint(state.grid, self.samples.radius, state.scene.device))
        restriction = restrict(problem, state)
        if restriction is None:
            return found
        return replace(
            found,
            dof=restriction.dof,
            scene_from_frame=restriction.motion.scene_from_frame.numpy(),
            scene=replace(found.scene, nodes=restriction.scene(state)),
        )

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
            dof=found.dof,
            gain_variance=samples.gain_variance,
            controls=None if found.displacement is None else found.displacement.grid.at(samples.positions[chosen]),
            places=None if self.places is None else torch.from_numpy(self.places),
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


def _unbiased_residual(bent: Registration, samples: Samples) -> float:
    """Return what frames that bend leave, as it would be if their control points had not followed the noise."""
    assert bent.displacement is not None
    taken = int((samples.weighted(torch.from_numpy(bent.used)).weights > 0).sum())
    unknowns = 2 * int(bent.used.sum()) * bent.displacement.control.shape[-1]
    return float(bent.residual / np.sqrt(max(1 - unknowns / max(taken, 1), 1e-6)))


def _light(samples: Samples, found: Registration) -> float:
    """Return the mean light of the samples of frames that take part, full scale 1."""
    samples = samples.weighted(torch.from_numpy(found.used))
    return max(float(steady.weighted_mean(samples.grey, samples.weights)), _LEAST_LIGHT)


def _frame_weights(problem: JointProblem, state: JointState, used: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return how much each frame should count, (T,), by how well it fits the scene: a blurred one fits worse."""
    left = (problem.values - predict(problem, state)).square() * problem.weights
    error = (left.sum(dim=1) / problem.weights.sum(dim=1).clamp_min(1e-9)).cpu().numpy()
    usual = np.median(error[used])
    weights: NDArray[np.float32] = (used * np.clip(usual / np.maximum(error, 1e-12), 0, 1)).astype(np.float32)
    return weights
