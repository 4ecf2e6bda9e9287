"""Encodings against their equations, by hand."""

import math

import numpy as np
import pytest
import torch

from napari_fiberburst.networks.encodings import Coordinates, HashGrid, Octaves, RandomFourier
from napari_fiberburst.networks.layers import make_siren
from napari_fiberburst.settings import Hash


def seeded():
    return torch.Generator().manual_seed(0)


def test_coordinates_are_themselves():
    points = torch.rand(4, 2)
    assert torch.equal(Coordinates(2)(points), points)


def test_octaves_of_a_point():
    encoding = Octaves(2, highest_octave=1)
    x, y = 0.25, -0.5
    angles = [math.pi * x, 2 * math.pi * x, math.pi * y, 2 * math.pi * y]
    expected = [x, y, *map(math.sin, angles), *map(math.cos, angles)]
    np.testing.assert_allclose(encoding(torch.tensor([[x, y]]))[0], expected, atol=1e-6)
    assert encoding.width == len(expected)


def test_the_published_octaves_reach_from_pi_to_32768_pi():
    frequencies = Octaves(2, highest_octave=15).frequencies
    assert len(frequencies) == 16
    assert frequencies[0].item() == pytest.approx(math.pi)
    assert frequencies[-1].item() == pytest.approx(2**15 * math.pi)


def test_fourier_features_of_a_point():
    encoding = RandomFourier(2, features=3, sigma=2.0, generator=seeded())
    point = torch.tensor([[0.3, -0.7]])
    angles = [2 * math.pi * 2.0 * (0.3 * bx - 0.7 * by) for bx, by in encoding.directions.tolist()]
    expected = [0.3, -0.7, *map(math.sin, angles), *map(math.cos, angles)]
    np.testing.assert_allclose(encoding(point)[0], expected, atol=1e-5)
    assert encoding.width == len(expected)


def test_sigma_is_the_spread_of_the_frequencies():
    encoding = RandomFourier(2, features=20_000, sigma=5.0, generator=seeded())
    frequencies = encoding.sigma * encoding.directions
    assert frequencies.std().item() == pytest.approx(5, rel=0.02)
    assert frequencies.mean().item() == pytest.approx(0, abs=0.05)


def test_random_frequencies_are_not_trained():
    encoding = RandomFourier(2, features=3, sigma=2.0, generator=seeded())
    assert list(encoding.parameters()) == []
    assert encoding.width == 2 + 2 * 3


def test_published_hash_resolutions_and_sizes():
    grid = HashGrid(2, Hash(), seeded())
    assert grid.width == 24
    assert grid.resolutions[:4] == [4, 6, 10, 16]
    assert grid.resolutions[-1] == math.floor(4 * 1.61**11) == 753
    assert max(len(table) for table in grid.tables) == 2**16


def test_a_hash_level_blends_its_corners_linearly():
    grid = HashGrid(2, Hash(levels=1, base_resolution=4), seeded())
    # 4 cells across [-1, 1]: grid points half a unit apart, 9 a side over the stored [-2, 2]
    assert len(grid.tables[0]) == 81
    table = grid.tables[0].detach().view(9, 9, 2)  # [row, column]
    np.testing.assert_allclose(grid(torch.tensor([[-1.0, 0.5]]))[0].detach(), table[5, 2], atol=1e-9)
    between = grid(torch.tensor([[-0.75, 0.625]]))[0].detach()  # half way on x, a quarter on y
    corners = table[5:7, 2:4]
    expected = 0.75 * corners[0].mean(dim=0) + 0.25 * corners[1].mean(dim=0)
    np.testing.assert_allclose(between, expected, atol=1e-9)


def test_a_hash_level_too_large_for_its_table_hashes_as_published():
    grid = HashGrid(2, Hash(levels=1, base_resolution=40, table_bits=8), seeded())
    assert len(grid.tables[0]) == 2**8
    corner = torch.tensor([[[3, 5]]])
    place = grid._places(corner, side=81, length=2**8).item()
    assert place == (3 ^ (5 * 2_654_435_761)) % 2**8


@pytest.mark.parametrize("dimensions", [2, 3])
def test_the_hash_grid_is_smooth_in_its_points_and_learns(dimensions):
    grid = HashGrid(dimensions, Hash(levels=3, table_bits=8), seeded()).double()
    points = (torch.rand(6, dimensions, generator=seeded(), dtype=torch.float64) * 1.8 - 0.9).requires_grad_()
    assert torch.autograd.gradcheck(grid, (points,), eps=1e-7, atol=1e-6)
    grid(points).sum().backward()
    assert all(table.grad.abs().sum() > 0 for table in grid.tables)


def test_points_beyond_the_stored_margin_hold_the_nearest_value():
    grid = HashGrid(2, Hash(levels=2), seeded())
    far, near = torch.tensor([[5.0, 0.1]]), torch.tensor([[2.0, 0.1]])
    np.testing.assert_allclose(grid(far).detach(), grid(near).detach(), atol=1e-9)


def test_points_that_are_no_numbers_give_no_numbers():
    grid = HashGrid(2, Hash(levels=2), seeded())
    assert grid(torch.tensor([[torch.nan, 0.1]])).isnan().all()


def test_siren_is_sines_of_thirty_times_its_layers():
    network = make_siren([2, 4, 1], 30.0, seeded())
    first, last = network[0], network[2]
    point = torch.tensor([[0.2, -0.1]])
    hidden = torch.sin(30 * (point @ first.weight.T + first.bias))
    np.testing.assert_allclose(network(point).detach(), (hidden @ last.weight.T + last.bias).detach(), atol=1e-6)
    assert first.weight.abs().max() <= 1 / 2
    assert last.weight.abs().max() <= math.sqrt(6 / 4) / 30
