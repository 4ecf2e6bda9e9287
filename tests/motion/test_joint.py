"""Scene, motion, gains and exposures are found together, and the Jacobian is that of the model."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.motion.levels import through_levels

from napari_fiberburst.coordinates import relative_to, transform_points
from napari_fiberburst.motion.coarse import find_shifts
from napari_fiberburst.motion.displacement import ControlGrid, Displacement
from napari_fiberburst.motion.joint import enter, iterate, predict, start
from napari_fiberburst.motion.linearised import linearise
from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.motion.problem import COARSE, JointProblem

SHAPE = (120, 140)
PITCH = 5.0


def problem_of(positions, values, **changes):
    count = len(positions)
    known = {"core_index": torch.arange(count), "cores": count, "pitch": PITCH, "dof": 8}
    return JointProblem(positions=positions, values=values, weights=torch.ones_like(values), **{**known, **changes})


def error(motion, truth):
    corners = np.array([[0.0, 0], [139, 0], [0, 119], [139, 119]])
    found = relative_to(motion.scene_from_frame.numpy(), 0)
    return np.abs(transform_points(found, corners) - transform_points(truth, corners)).max()


def registered(problem):
    shifts = find_shifts(problem.positions, problem.values, problem.weights, SHAPE, PITCH).shifts
    return through_levels(problem, shifts, SHAPE)


@pytest.mark.parametrize("spread", [0.0, 0.15])
def test_rotation_and_gains_are_found(positions, matrices, look, spread):
    gains = 1 + spread * torch.randn(900, generator=torch.Generator().manual_seed(2))
    state = registered(problem_of(positions, look(positions, matrices()) * gains))
    assert error(state.motion, matrices()) < 0.3
    assert float(state.gains.median()) == pytest.approx(1)
    seen_often = torch.from_numpy((np.abs(positions.numpy() - [69.5, 59.5]) < [45, 38]).all(axis=1))
    left = (state.gains / gains)[seen_often]
    assert float(left.std() / left.mean()) < 0.02


def test_known_gains_stay_as_they_are(positions, matrices, look):
    state = registered(problem_of(positions, look(positions, matrices()), gain_variance=0.0))
    assert error(state.motion, matrices()) < 0.3
    assert torch.equal(state.gains, torch.ones(900))


def test_samples_of_one_core_share_a_gain(positions, matrices, look):
    core_index = torch.arange(900) // 3
    gains = 1 + 0.15 * torch.randn(301, generator=torch.Generator().manual_seed(4))
    values = look(positions, matrices()) * gains[core_index]
    state = registered(problem_of(positions, values, core_index=core_index, cores=301))
    assert state.gains.shape == (301,)
    assert float(state.gains[300]) == pytest.approx(1, abs=0.1)  # of a core without samples, only what all share
    left = (state.gains / gains)[:300]
    assert float(left.std() / left.mean()) < 0.04


@pytest.mark.parametrize("radius", [None, 2.3])
@pytest.mark.parametrize("dof", [2, 8])
def test_the_jacobian_is_the_slope_of_the_model(positions, matrices, look, radius, dof):
    torch.manual_seed(0)
    values = look(positions, matrices()).double()
    problem = problem_of(positions.double(), values, dof=dof)
    gains = 1 + 0.1 * torch.randn(900, dtype=torch.float64)
    state = start(problem, FrameMotion(torch.from_numpy(matrices()), SHAPE))
    exposures = 1 + 0.2 * torch.randn(5, dtype=torch.float64)
    state = replace(enter(problem, state, COARSE, radius), gains=gains, exposures=exposures)
    # A scene without kinks at its nodes has one slope: linear interpolation of a plane.
    nodes = state.grid.nodes().double()
    state = replace(state, scene=1 + 0.004 * nodes[..., 0] - 0.003 * nodes[..., 1])
    scene, motion, change, log_exposures = (
        torch.randn(state.grid.shape).double(),
        torch.randn(5, dof).double(),
        torch.randn(900).double(),
        torch.randn(5).double(),
    )
    step = 1e-4
    moved = replace(
        state,
        scene=state.scene + step * scene,
        motion=state.motion.moved(step * motion),
        gains=state.gains + step * change,
        exposures=state.exposures * (step * log_exposures).exp(),
    )
    slope = (predict(problem, moved) - predict(problem, state)) / step
    jacobian, of_gains = linearise(problem, state, replace(COARSE, dof=dof))
    expected = jacobian((scene, motion, log_exposures)) + of_gains(change)
    inside = ((positions > 12) & (positions < torch.tensor([127.0, 107.0]))).all(dim=1)
    torch.testing.assert_close(slope[:, inside], expected[:, inside], rtol=0.02, atol=0.02)


@pytest.mark.parametrize("radius", [None, 2.3])
def test_the_jacobian_of_control_points_is_the_slope_of_the_model(positions, matrices, look, radius):
    torch.manual_seed(0)
    grid = ControlGrid.over(SHAPE, 25.0)
    controls = grid.at(positions.double())
    problem = problem_of(positions.double(), look(positions, matrices()).double(), controls=controls)
    control = torch.randn(5, 2, grid.shape[0] * grid.shape[1]).double()
    motion = FrameMotion(torch.from_numpy(matrices()), SHAPE, Displacement(grid, control))
    state = enter(problem, start(problem, motion), COARSE, radius)
    nodes = state.grid.nodes().double()
    state = replace(state, scene=1 + 0.004 * nodes[..., 0] - 0.003 * nodes[..., 1])
    steps = torch.randn_like(control)
    moved = replace(state, motion=replace(motion, displacement=Displacement(grid, control + 1e-4 * steps)))
    slope = (predict(problem, moved) - predict(problem, state)) / 1e-4
    level = replace(COARSE, bends=True)
    jacobian, _ = linearise(problem, state, level)
    expected = jacobian((torch.zeros_like(state.scene), steps, torch.zeros(5).double()))
    inside = ((positions > 12) & (positions < torch.tensor([127.0, 107.0]))).all(dim=1)
    torch.testing.assert_close(slope[:, inside], expected[:, inside], rtol=0.02, atol=0.002)


@pytest.mark.parametrize("flicker", [0.05, 0.3])
def test_exposures_are_found(positions, matrices, look, flicker):
    exposures = np.exp(flicker * np.array([0.9, -1.2, 0.4, 1.1, -0.7]))
    gains = 1 + 0.15 * torch.randn(900, generator=torch.Generator().manual_seed(2))
    values = look(positions, matrices()) * gains * torch.from_numpy(exposures).float()[:, None]
    state = registered(problem_of(positions, values))
    assert error(state.motion, matrices()) < 0.3
    left = np.log(state.exposures.numpy() / exposures)
    assert np.ptp(left) < 0.02
    assert float(state.exposures.log().mean()) == pytest.approx(0, abs=1e-3)


def test_an_even_burst_has_even_exposures(positions, matrices, look):
    gains = 1 + 0.15 * torch.randn(900, generator=torch.Generator().manual_seed(2))
    state = registered(problem_of(positions, look(positions, matrices()) * gains))
    assert float(state.exposures.std()) < 0.004


def test_an_iteration_lowers_what_is_left(positions, matrices, look):
    problem = problem_of(positions, look(positions, matrices()))
    shifts = find_shifts(positions, problem.values, problem.weights, SHAPE, PITCH).shifts
    state = enter(problem, start(problem, FrameMotion.of_shifts(shifts, SHAPE)), COARSE, None)
    left = []
    for number in range(6):
        state, _ = iterate(problem, state, COARSE, number)
        left.append(state.residual)
    assert left[-1] < 0.2 * left[0]


def test_frames_left_out_neither_move_nor_count(positions, matrices, look):
    values = look(positions, matrices())
    values[3] = torch.rand(900, generator=torch.Generator().manual_seed(3))
    problem = problem_of(positions, values).without(torch.arange(5) == 3)
    state = registered(problem)
    others = [0, 1, 2, 4]
    assert (
        error(replace(state.motion, scene_from_frame=state.motion.scene_from_frame[others]), matrices()[others]) < 0.3
    )
