"""Images are linear between the nodes of a grid; stencil, slopes and filters belong to that."""

import pytest
import torch

from napari_fiberburst.operators.filters import blur, local_mean
from napari_fiberburst.operators.footprint import Footprint, disc
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.operators.priors import MEMBRANE, THIN_PLATE


@pytest.fixture
def grid():
    return Grid.over((-3.0, 2.0, 20.0, 33.0), 1.7)


@pytest.fixture
def points():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(200, 2, generator=generator) * torch.tensor([22.0, 30.0]) + torch.tensor([-3.0, 2.0])


def test_a_plane_is_sampled_exactly_and_has_its_slopes(grid, points):
    nodes = grid.nodes()
    plane = 2 * nodes[..., 0] - 3 * nodes[..., 1] + 5
    at = grid.at(points)
    torch.testing.assert_close(at(plane), 2 * points[:, 0] - 3 * points[:, 1] + 5, rtol=0, atol=1e-4)
    values, along_x, along_y = at.with_slopes(plane)
    torch.testing.assert_close(values, at(plane), rtol=0, atol=1e-4)
    torch.testing.assert_close(along_x, torch.full_like(along_x, 2.0), rtol=0, atol=1e-4)
    torch.testing.assert_close(along_y, torch.full_like(along_y, -3.0), rtol=0, atol=1e-4)


def test_outside_there_is_nothing_to_sample_or_to_splat_on(grid):
    at = grid.at(torch.tensor([[-3.1, 5.0], [5.0, 1.9], [float("nan"), 3.0], [1e9, 1e9]]))
    assert not at.inside.any()
    assert not at(torch.ones(grid.shape)).any()
    assert not at.adjoint(torch.ones(4)).any()
    assert not any(part.any() for part in at.with_slopes(torch.rand(grid.shape)))


def test_a_part_of_a_grid_does_to_its_points_what_the_grid_does(grid, points):
    near, weights = points[(points[:, 0] > 5) & (points[:, 0] < 11) & (points[:, 1] < 25)], torch.rand(200)
    part, nodes = grid.part_about(torch.cat([near, torch.tensor([[float("nan"), 3.0], [-90.0, 5.0]])]))
    assert part.shape[0] < grid.shape[0]
    assert part.shape[1] < grid.shape[1]
    torch.testing.assert_close(part.nodes(), grid.nodes()[nodes], rtol=0, atol=1e-5)
    whole = torch.zeros(grid.shape)
    whole[nodes] = part.at(near).adjoint(weights[: len(near)])
    torch.testing.assert_close(whole, grid.at(near).adjoint(weights[: len(near)]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("place", [(50.0, 50.0), (20.7, 33.0), (-3.0, 2.0)])
def test_a_part_has_a_cell_at_least_and_stays_in_its_grid(grid, place):
    part, (rows, columns) = grid.part_about(torch.tensor([place]))
    assert part.shape == (2, 2)
    for some, count in zip((rows, columns), grid.shape, strict=True):
        assert 0 <= some.start < some.stop <= count


def test_the_stencil_is_sample_then_weigh_then_splat(grid, points):
    image, weights = torch.rand(2, *grid.shape), torch.rand(200)
    at = grid.at(points)
    by_stencil = at.normal(weights)(image)
    by_hand = torch.stack([at.adjoint(weights * at(part)) for part in image])
    torch.testing.assert_close(by_stencil, by_hand, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(at.normal(weights).diagonal, at.normal_diagonal(weights))


def test_the_membrane_is_the_slope_of_its_energy():
    image = torch.rand(7, 5, dtype=torch.float64, requires_grad=True)
    energy = ((image[1:] - image[:-1]) ** 2).sum() + ((image[:, 1:] - image[:, :-1]) ** 2).sum()
    energy.backward()
    torch.testing.assert_close(MEMBRANE(image.detach()), image.grad / 2)


@pytest.mark.parametrize("prior", [MEMBRANE, THIN_PLATE])
def test_a_prior_does_to_waves_what_its_response_says(prior):
    frequency = torch.tensor([0.2, 0.375], dtype=torch.float64)
    y, x = (torch.arange(80, dtype=torch.float64) for _ in range(2))
    wave = torch.cos(2 * torch.pi * (0.2 * y[:, None] + 0.375 * x))
    inside = (slice(4, -4), slice(4, -4))
    expected = prior.response(frequency[:1], frequency[1:])[0, 0] * wave
    torch.testing.assert_close(prior(wave)[inside], expected[inside])
    point = torch.zeros(9, 11)
    point[4, 5] = 1
    assert float(prior(point)[4, 5]) == prior.diagonal


def test_a_blurred_point_is_a_gaussian():
    image = torch.zeros(41, 51, dtype=torch.float64)
    image[20, 24] = 1
    spread = blur(image, 2.5)
    offset = torch.arange(51) - 24
    profile = spread[20] / spread[20, 24]
    torch.testing.assert_close(profile, torch.exp(-(offset.double() ** 2) / (2 * 2.5**2)), rtol=0, atol=1e-3)
    assert float(local_mean(torch.ones(30, 20), 3.0).min()) == pytest.approx(1, abs=1e-3)


def test_a_footprint_is_a_disc_of_its_radius():
    grid = Grid.over((0, 0, 40, 30), 1.0)
    footprint = Footprint(grid, 3.0, torch.device("cpu"))
    kernel = disc(3.0, 0.05)
    offset = torch.arange(kernel.shape[0]) - kernel.shape[0] // 2
    spread = (kernel * (offset[:, None] ** 2 + offset[None, :] ** 2)).sum()
    assert float(spread) == pytest.approx(3.0**2 / 2, rel=0.05)  # second moment of an even disc
    assert float(footprint.transfer(torch.zeros(1), torch.zeros(1))) == pytest.approx(1)


@pytest.mark.parametrize("radius", [2.7, 40.0])
def test_a_large_image_is_filtered_in_parts_without_seams(radius):
    shape, margin = (1801, 1147), 60
    images = torch.randn(2, *shape, generator=torch.Generator().manual_seed(0))
    device = torch.device("cpu")
    filtered = Footprint(Grid(0.0, 0.0, 1.3, shape), radius, device)(images)
    for top in range(0, shape[0], 601):  # parts that are small enough to be filtered whole
        rows = slice(max(0, top - margin), min(shape[0], top + 601 + margin))
        part = images[:, rows]
        whole = Footprint(Grid(0.0, 0.0, 1.3, tuple(part.shape[1:])), radius, device)(part)
        own = slice(top - rows.start, top - rows.start + min(601, shape[0] - top))
        torch.testing.assert_close(filtered[:, top : top + 601], whole[:, own], rtol=0, atol=2e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(2, 2), (13, 2), (31, 37)])
def test_reading_is_the_mean_of_four_nodes_by_nearness_up_to_the_edges(shape, dtype):
    rows, columns = shape
    at = Grid(-3.0, 2.0, 1.3, shape)
    inner = torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=dtype)
    places = torch.cat([inner, torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], dtype=dtype)])
    places = places * torch.tensor([columns - 1, rows - 1], dtype=dtype)
    images = torch.randn(3, *shape, generator=torch.Generator().manual_seed(1), dtype=dtype)
    sampling = at.at(places * 1.3 + torch.tensor([-3.0, 2.0], dtype=dtype))
    inside = sampling.inside
    assert inside[:50].all()
    j, i = (part.floor().long().clamp(max=side - 2) for part, side in zip(places.T, (columns, rows), strict=True))
    x, y = places[:, 0] - j, places[:, 1] - i
    upper = (1 - x) * images[:, i, j] + x * images[:, i, j + 1]
    lower = (1 - x) * images[:, i + 1, j] + x * images[:, i + 1, j + 1]
    expected = ((1 - y) * upper + y * lower) * inside
    tolerance = {torch.float32: 2e-5, torch.float64: 1e-12}[dtype]
    torch.testing.assert_close(sampling.of_channels(images), expected.T, rtol=0, atol=tolerance)
    torch.testing.assert_close(sampling(images[0]), expected[0], rtol=0, atol=tolerance)
