"""Displacements are cubic splines over the frame, and can be inverted."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from napari_fiberburst.motion.displacement import ControlGrid, Displacement
from napari_fiberburst.motion.models import FrameMotion

SHAPE = (61, 83)


def bent(size, generator=None):
    grid = ControlGrid.over(SHAPE, 17.0)
    generator = torch.Generator().manual_seed(3) if generator is None else generator
    return Displacement(grid, size * torch.randn(3, 2, grid.shape[0] * grid.shape[1], generator=generator))


def test_control_points_cover_the_frame_and_a_row_beyond():
    grid = ControlGrid.over(SHAPE, 17.0)
    assert grid.shape == (3 + 4, 4 + 4)
    index, weight = grid.splines(torch.tensor([[0.0, 0.0], [82.0, 60.0], [500.0, -9.0]]))
    assert int(index.min()) >= 0
    assert int(index.max()) < 56
    torch.testing.assert_close(weight.sum(dim=1), torch.ones(3))


def test_a_displacement_is_scipys_spline():
    displacement = bent(2.0)
    rows, columns = displacement.grid.shape
    control = displacement.control[1, 0].reshape(rows, columns).numpy()
    x = np.linspace(0, 82, 40)
    knots = (np.arange(columns + 4) - 3.0) * 17.0
    along_y = BSpline((np.arange(rows + 4) - 3.0) * 17.0, control, 3)(23.5)
    expected = BSpline(knots, along_y, 3)(x)
    points = torch.from_numpy(np.stack([x, np.full_like(x, 23.5)], axis=1)).float()
    np.testing.assert_allclose(displacement.at(points)[1, :, 0].numpy(), expected, atol=1e-4)
    weights = displacement.grid.at(points)
    torch.testing.assert_close(weights(displacement.control).mT, displacement.at(points), atol=1e-5, rtol=1e-5)


def test_many_points_are_displaced_as_few_are():
    displacement = bent(1.0)
    rows, columns = displacement.grid.nodes.shape
    generator = torch.Generator().manual_seed(4)
    points = torch.rand(rows * columns + 1, 2, generator=generator) * torch.tensor([103.0, 81.0]) - 10
    few = torch.cat([displacement.at(part) for part in points.split(1000)], dim=1)
    assert float((displacement.at(points) - few).abs().max()) < 0.005
    corners = torch.tensor([[0.0, 0.0], [82.0, 60.0], [500.0, -9.0]])
    many = displacement.at(torch.cat([points, corners]))[:, -3:]
    torch.testing.assert_close(many, displacement.at(corners), atol=1e-3, rtol=0)


@pytest.mark.parametrize("reference", [0, 2])
def test_the_reference_frame_is_where_it_was(reference):
    matrices = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1)
    matrices[:, :2, 2] = torch.tensor([[0.0, 0], [4, -3], [-7, 2]])
    motion = FrameMotion(matrices, SHAPE, bent(1.5))
    y, x = torch.meshgrid(torch.arange(4.0, 58, 9), torch.arange(5.0, 80, 9), indexing="ij")
    points = torch.stack([x, y], dim=-1).reshape(-1, 2)
    places = motion.apply(points)
    torch.testing.assert_close(motion.to_reference(places, reference)[reference], points, atol=0.01, rtol=0)
    assert float((motion.to_reference(places, reference)[1 - reference // 2] - points).abs().max()) > 1


def test_a_displacement_has_a_size():
    grid = ControlGrid.over(SHAPE, 17.0)
    even = torch.zeros(2, 2, grid.shape[0] * grid.shape[1])
    even[1, 0], even[1, 1] = 3.0, -4.0
    torch.testing.assert_close(Displacement(grid, even).size(SHAPE), torch.tensor([0.0, 5.0]))


def test_a_displacement_moves_with_its_points():
    grid = ControlGrid.over((97, 121), 20.0)
    y, x = torch.meshgrid(*(torch.arange(count) * 20.0 - 20.0 for count in grid.shape), indexing="ij")
    control = torch.stack([torch.sin(x / 40) + y / 50, torch.cos(y / 45)]).reshape(1, 2, -1).repeat(2, 1, 1)
    bends = Displacement(grid, control)
    offsets = torch.tensor([[2.5, -1.5], [0.0, 3.0]], dtype=torch.float64)
    points = torch.tensor([[31.0, 42.0], [60.0, 55.0], [83.0, 37.0]])
    moved = bends.moved(offsets)
    for number, offset in enumerate(offsets):
        there = moved.at(points + offset.float())[number]
        torch.testing.assert_close(there, bends.at(points)[number], atol=0.02, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_of_control_points_are_a_matrix_and_its_transpose(dtype):
    grid = ControlGrid(8.0, (7, 9))
    generator = torch.Generator().manual_seed(0)
    # All on one side, so that some control points have no place near them.
    places = 20 * torch.rand(53, 2, generator=generator, dtype=dtype)
    weights, (index, entries) = grid.at(places), grid.splines(places)
    matrix = torch.zeros(53, 63, dtype=dtype).scatter_add_(1, index, entries)
    assert bool((matrix == 0).all(dim=0).any())
    control, values = (torch.randn(3, 2, count, generator=generator, dtype=dtype) for count in (63, 53))
    torch.testing.assert_close(weights(control), control @ matrix.T)
    torch.testing.assert_close(weights.adjoint(values), values @ matrix)
    torch.testing.assert_close(weights.normal_diagonal(values), values @ matrix.square())
