"""Joint registration: scene, motion, gains and exposures of all frames solved together, by Gauss-Newton.

Each sample n, at a fixed place x_n of the frame, has a gain g_n and sees the scene s, through its footprint B, where
frame t's transform T_t and displacement D_t take it, at that frame's exposure a_t:

    v_tn = a_t g_n (B s)(T_t x_n + D_t(x_n)) + noise

Every iteration linearises this in (s, T or D, g, log a) at once and solves the normal equations by conjugate gradients,
with a membrane prior on the change of s. Alternating between scene, motion and gains takes many times the iterations,
because each hides the errors of the others. The joint iteration finds rotation and perspective from a coarse shift, and
tells a core's gain from the scene behind it.

Some changes no sample shows. One factor may go from the scene to all gains or exposures; and a scene that is brighter
by exp(c p) at the place p looks the same where gains fall by exp(-c x), and exposures by what the frames' shifts make
of it. So the exposures have the geometric mean 1, the gains the median 1 and no slope over the field.
"""

from dataclasses import replace

import torch
from torch import Tensor

from napari_fiberburst.motion.linearised import Linearised, huber
from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.motion.problem import COARSE, LEAST_DAMPING, JointProblem, JointState, Level
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.filters import filled_mean
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Sampling

# Relative standard deviation of exposures below which they are taken as one.
_LEAST_FLICKER = 3e-4
# Relative change of the gains from the middle of the field to its edge that the most even bundle may have, where they
# are not known better.
_UNEVENNESS = 0.02
# Alternations of scene and exposures before the first iteration.
_EXPOSURE_ROUNDS = 8
# A gain further from 1 than this factor is not believed.
_LARGEST_GAIN = 50.0
# In pitches: control points move at most so far in one iteration.
_LONGEST_STEP = 1.5


def start(problem: JointProblem, motion: FrameMotion) -> JointState:
    """Return the state before the first iteration, all gains 1: exposures and scene by the frames as they lie.

    A frame's exposure is its light relative to the mean of all frames where it overlaps them, which changes in turn.
    """
    grid = problem.grid(motion, COARSE.spacing)
    sampling = grid.at(problem.points(motion))
    weights = problem.weights * sampling.inside
    exposures = torch.ones(len(weights)).to(weights)
    for _ in range(_EXPOSURE_ROUNDS):
        nodes = _mean_scene(problem, sampling, exposures)
        light = sampling(nodes)
        agreement, power = ((weights * part).sum(dim=1) for part in (problem.values * light, light**2))
        exposures = torch.where(agreement > 0, agreement / power.clamp_min(1e-12), exposures)
        exposures = exposures / _common_exposure(problem, exposures)
    gains = torch.ones(problem.cores, dtype=weights.dtype, device=weights.device)
    nodes = _mean_scene(problem, sampling, exposures)
    return JointState(motion=motion, grid=grid, scene=nodes, gains=gains, exposures=exposures)


def _mean_scene(problem: JointProblem, sampling: Sampling, exposures: Tensor) -> Tensor:
    """Return the mean of the frames as they lie, each brought to exposure 1."""
    values, weights = problem.values / exposures[:, None], problem.weights * exposures[:, None] ** 2
    return filled_mean(sampling.adjoint(values * weights), sampling.adjoint(weights), 1.0 / COARSE.spacing)


def _common_exposure(problem: JointProblem, exposures: Tensor) -> Tensor:
    """Return the geometric mean of the exposures of frames with weight."""
    used = (problem.weights > 0).any(dim=1)
    return exposures[used].log().mean().exp() if bool(used.any()) else exposures.new_tensor(1.0)


def enter(problem: JointProblem, state: JointState, level: Level, radius: float | None) -> JointState:
    """Return the state carried over to a level's grid; `radius` is of the footprint, pixels, None for points."""
    grid = problem.grid(state.motion, level.spacing)
    device = problem.positions.device
    scene = state.grid.at(grid.nodes(device))(state.scene)
    footprint = None if radius is None else Footprint(grid, radius, device)
    moved = replace(state, grid=grid, scene=scene, footprint=footprint)
    light = grid.at(problem.points(moved.motion))(moved.filtered) * moved.exposures[:, None]
    brightness = steady.total(problem.weights * light * problem.values) / steady.total(problem.weights * light**2)
    return replace(moved, scene=scene * float(brightness))


def iterate(problem: JointProblem, state: JointState, level: Level, number: int) -> tuple[JointState, float]:
    """Do one Gauss-Newton iteration.

    Parameters
    ----------
    problem, state
        Of which, and from where.
    level : Level
        That was entered.
    number : int
        Iterations done at this level.

    Returns
    -------
    JointState, float
        The new state, and the largest displacement of a frame's centre, pixels.
    """
    damping = max(level.damping * level.decay**number, LEAST_DAMPING)
    system = Linearised.of(problem, state, level, damping)
    scene, steps, log_exposures = system.solve()
    if level.bends:
        motion, farthest = _bent(problem, state.motion, steps)
    else:
        motion, farthest = state.motion.moved(steps), state.motion.travel(steps)
    moved = replace(
        state,
        motion=motion,
        scene=state.scene + scene,
        exposures=state.exposures * log_exposures.clamp(-1, 1).exp(),
        residual=float(system.variance**0.5),
    )
    if problem.gain_variance > 0:
        moved = _level(problem, _with_best_gains(problem, moved, system.gain_prior))
    return moved, farthest


def _bent(problem: JointProblem, motion: FrameMotion, steps: Tensor) -> tuple[FrameMotion, float]:
    """Return the motion bent by steps (T, 2, M) of its control points, and how far frames went, pixels.

    The displacements keep the mean 0 over the frames: the scene has the frames' mean shape. With one frame held fixed
    instead, the scene and all other frames would have to move together, which takes far more iterations.
    """
    displacement = motion.displacement
    assert displacement is not None
    used = (problem.weights > 0).any(dim=1)
    longest = steps.norm(dim=1, keepdim=True).clamp_min(1e-12)
    steps = steps * (_LONGEST_STEP * problem.pitch / longest).clamp(max=1) * used[:, None, None]
    control = displacement.control + steps
    control = control - control[used].mean(dim=0) * used[:, None, None]
    farthest = float(steps.square().sum(dim=1).mean(dim=1).max().sqrt())
    return replace(motion, displacement=replace(displacement, control=control)), farthest


def normalise(problem: JointProblem, state: JointState) -> JointState:
    """Return the state with what all gains, and all exposures, have in common moved into the scene."""
    measured = torch.bincount(problem.core_index, minlength=problem.cores) > 0
    common = state.gains[measured].median()
    exposure = _common_exposure(problem, state.exposures)
    return replace(
        state, gains=state.gains / common, exposures=state.exposures / exposure, scene=state.scene * common * exposure
    )


def _level(problem: JointProblem, state: JointState) -> JointState:
    """Return the state with that slope of the gains over the field moved into scene and exposures which is none.

    A bundle is nearly even, so its gains have hardly any slope. Where the exposures vary no more than what is left of
    it makes of them, they are the same for all frames, which tells the slope better. A bundle that moves on the camera
    makes frames darker that had to be interpolated, so exposures are compared only where it is in the same place.
    """
    device, count = problem.positions.device, problem.cores
    mass = torch.bincount(problem.core_index, minlength=count).to(problem.positions)
    places = torch.zeros(count, 2, device=device).index_add_(0, problem.core_index, problem.positions)
    places = places / mass.clamp_min(1)[:, None]
    measured = mass > 0
    middle = places[measured].mean(dim=0)
    used = (problem.weights > 0).any(dim=1)
    centres = state.motion.apply(middle[None])[:, 0]
    places_of_frames = torch.zeros(len(used), dtype=torch.int64) if problem.places is None else problem.places.cpu()
    slope = _slope(
        (places[measured] - middle).cpu().double(),
        state.gains[measured].log().cpu().double(),
        (centres - middle)[used].cpu().double(),
        state.exposures[used].log().cpu().double(),
        places_of_frames[used.cpu()],
        min(_UNEVENNESS, problem.gain_variance**0.5),
    ).to(places)
    return replace(
        state,
        gains=state.gains * torch.exp(-(places - middle) @ slope),
        exposures=state.exposures * torch.exp(-(centres - middle) @ slope),
        scene=state.scene * torch.exp((state.grid.nodes(device) - middle) @ slope),
    )


def _slope(
    places: Tensor, log_gains: Tensor, shifts: Tensor, log_exposures: Tensor, groups: Tensor, unevenness: float
) -> Tensor:
    """Return the slope (2,) that is to be moved out of the gains (G,), at places (G, 2), and exposures (T,).

    Exposures are compared within each group of frames (T,) alone. The gains may change by about `unevenness` from the
    middle of the field to its edge.
    """
    log_gains = log_gains - log_gains.mean(dim=0)
    log_exposures, shifts = log_exposures.clone(), shifts.clone()
    numbers = set(groups.tolist())
    for number in numbers:
        members = groups == number
        for part in (log_exposures, shifts):
            part[members] -= part[members].mean(dim=0)
    information = places.T @ places + 1e-9 * torch.eye(2).double()
    by_gains = torch.linalg.solve(information, places.T @ log_gains)
    covariance = torch.linalg.inv(information) * (log_gains - places @ by_gains).square().mean()
    half = places.abs().amax().clamp_min(1.0)
    information = torch.linalg.inv(covariance + (unevenness / half) ** 2 * torch.eye(2).double())
    left = log_exposures - shifts @ by_gains
    by_chance = (shifts @ torch.linalg.inv(information) * shifts).sum()
    variance = ((left.square().sum() - by_chance) / max(1, len(left) - len(numbers))).clamp_min(_LEAST_FLICKER**2)
    moments = shifts.T @ shifts / variance
    slope: Tensor = by_gains + torch.linalg.solve(information + moments, shifts.T @ left / variance)
    return slope


def predict(problem: JointProblem, state: JointState) -> Tensor:
    """Return what the model says of the values, (T, N)."""
    light = state.grid.at(problem.points(state.motion))(state.filtered)
    return state.exposures[:, None] * light * state.gains[problem.core_index]


def _with_best_gains(problem: JointProblem, state: JointState, prior: float) -> JointState:
    """Return the state with the best gains for scene and motion as they are.

    The joint step leaves out the product of two changes, which can be large where a gain is hardly known.
    """
    sampling = state.grid.at(problem.points(state.motion))
    light = state.exposures[:, None] * sampling(state.filtered)
    weights = problem.weights * sampling.inside
    weights = weights * huber(problem.values - state.gains[problem.core_index] * light, weights)
    agreement, power = (
        torch.zeros_like(state.gains).index_add_(0, problem.core_index, part.sum(dim=0))
        for part in (weights * problem.values * light, weights * light**2)
    )
    gains = (agreement + prior) / (power + prior)
    return replace(state, gains=gains.clamp(1 / _LARGEST_GAIN, _LARGEST_GAIN))
