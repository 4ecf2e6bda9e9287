"""Frames move along the generators of their model, and nowhere else: behind splines and behind networks."""

import numpy as np
import pytest
import torch

from napari_fiberburst.coordinates import unit_from_pixel
from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.networks.motion import AlignedField
from napari_fiberburst.settings import Affine, Homography, Similarity, Translation

MODELS = (Translation, Similarity, Affine, Homography)
# Odd sides, one three times the other: what a square frame would hide shows.
SHAPES = ((31, 37), (31, 97), (101, 33))


def by_registration(shape, steps):
    """Return where registration takes frames for steps (T, k) along the generators, (T, 3, 3) in pixels."""
    return FrameMotion.still(len(steps), shape).moved(steps).scene_from_frame.numpy()


def by_network(shape, steps):
    """Return where the motion of a network takes them."""
    field = AlignedField(torch.eye(3, dtype=torch.float64).repeat(len(steps), 1, 1), shape, steps.shape[1])
    field.steps.data = steps
    to_unit = unit_from_pixel(shape)
    return np.linalg.inv(to_unit) @ field.scene_from_frame().detach().numpy() @ to_unit


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("moved", [by_registration, by_network])
def test_frames_stay_in_the_group_of_their_model(moved, model, shape):
    steps = 0.2 * torch.randn(5, model.dof, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matrices = moved(shape, steps)
    matrices = matrices / matrices[:, 2:, 2:]
    if model is not Homography:
        np.testing.assert_allclose(matrices[:, 2], np.tile([0, 0, 1], (5, 1)), atol=1e-9)
    if model is Translation:
        np.testing.assert_allclose(matrices[:, :2, :2], np.tile(np.eye(2), (5, 1, 1)), atol=1e-9)
    if model is Similarity:
        stretch = np.linalg.svd(matrices[:, :2, :2], compute_uv=False)
        np.testing.assert_allclose(stretch[:, 0], stretch[:, 1], rtol=1e-9)
        assert np.ptp(stretch[:, 0]) > 1e-3
    if model is Affine:
        stretch = np.linalg.svd(matrices[:, :2, :2], compute_uv=False)
        assert (stretch[:, 0] / stretch[:, 1] > 1.001).all()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("model", MODELS)
def test_both_ways_take_the_same_steps(model, shape):
    steps = 0.2 * torch.randn(3, model.dof, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    first, second = by_registration(shape, steps), by_network(shape, steps)
    np.testing.assert_allclose(first, second / second[:, 2:, 2:], atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_slopes_along_generators_are_how_a_plane_changes(model):
    points = torch.rand(30, 2) * torch.tensor([37.0, 31.0])
    slope = torch.tensor([0.7, -0.4])
    for generator in range(model.dof):
        motion = FrameMotion.still(1, (31, 37))
        step = torch.zeros(1, model.dof)
        step[0, generator] = 1e-3
        slopes = motion.slopes(points, *slope.expand(30, 2).T, model.dof)
        change = (motion.moved(step).apply(points)[0] - points) @ slope / 1e-3
        torch.testing.assert_close(change, slopes[generator], rtol=0.02, atol=0.05)


def test_travel_is_how_far_the_middle_of_a_frame_goes():
    steps = torch.tensor([[0.01, 0.0, 0.3, 0.0], [0.03, -0.04, 0.0, 0.02]], dtype=torch.float64)
    motion = FrameMotion.still(2, (31, 37))
    middle = torch.tensor([[18.0, 15.0]], dtype=torch.float64)
    gone = (motion.moved(steps).apply(middle) - middle).norm(dim=-1).max()
    assert motion.travel(steps) == pytest.approx(float(gone), rel=0.03)


def test_frames_that_run_away_are_told():
    shifts = np.array([[0.0, 0], [5, 0], [40, 0], [0, 0], [0, 0]])
    matrices = FrameMotion.of_shifts(shifts, (31, 37)).scene_from_frame.clone()
    matrices[3, :2, :2] *= 2
    matrices[4, 0, 0] = torch.nan
    left = FrameMotion(matrices, (31, 37)).has_left(np.zeros((5, 2)), most=3.0)
    np.testing.assert_array_equal(left, [False, False, True, True, True])
