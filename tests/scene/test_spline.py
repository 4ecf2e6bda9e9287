"""The scene's linear solve, against waves whose every value is known."""

import math

import numpy as np
import pytest
import torch

from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.scene.image import SplineImage
from napari_fiberburst.scene.spline import NormalEquations

SHAPE = (41, 54)
INSIDE = (slice(6, -6), slice(6, -6))


def wave(points, period):
    """Return a wave along a slanting line, of this period along x."""
    phase = 2 * math.pi * (points[..., 0] / period + points[..., 1] / (2 * period))
    return 0.5 + 0.3 * torch.cos(phase)


def solved(points, period, smoothness, radius=None):
    grid = Grid(0.0, 0.0, 1.0, SHAPE)
    empty = NormalEquations.empty(grid, radius, 1, torch.device("cpu"))
    normal = empty.with_samples(points, wave(points, period)[:, None], torch.ones(len(points)))
    return normal, normal.solve(smoothness, iterations=200)


def everywhere(steps=7):
    """Return points that lie as often at one distance from a node as at another."""
    fine = Grid(0.0, 0.0, 1 / steps, tuple((side - 1) * steps for side in SHAPE))
    return fine.nodes().reshape(-1, 2)


@pytest.mark.parametrize(("period", "overshoot"), [(3.0, 0.5), (4.0, 0.28), (6.0, 0.12)])
def test_an_image_does_not_overshoot_as_its_spline_does(period, overshoot):
    normal, scene = solved(everywhere(), period, 1e-4)
    truth = wave(normal.grid.nodes(), period)
    spline, image = (
        float((shown[0] - truth)[INSIDE].abs().max()) / 0.3 for shown in (scene, normal.image(scene, 1e-4))
    )
    assert spline == pytest.approx(overshoot, rel=0.15)
    assert image < 0.04


@pytest.mark.parametrize("radius", [None, 1.3])
def test_where_the_prior_leads_an_image_has_what_it_leaves_of_a_wave(radius):
    period, smoothness = 6.0, 40.0
    normal, scene = solved(everywhere(), period, smoothness, radius)
    frequency = torch.tensor([1 / period]), torch.tensor([1 / (2 * period)])
    prior = sum(float(4 * torch.sin(math.pi * f) ** 2) for f in frequency)
    passed = 49 * (1.0 if radius is None else float(normal.footprint.transfer(*frequency[::-1])) ** 2)
    left = passed / (passed + smoothness * prior ** (1 if radius is None else 2))
    expected = left * (wave(normal.grid.nodes(), period) - 0.5)
    if radius is not None:  # the samples are of the wave itself, which the solution takes for filtered
        expected = expected / float(normal.footprint.transfer(*frequency[::-1]))
    shown = normal.image(scene, smoothness)[0] - 0.5
    inside = (slice(14, -14), slice(14, -14))
    torch.testing.assert_close(shown[inside], expected[inside], atol=0.015, rtol=0)


def test_samples_on_the_nodes_are_left_as_they_are():
    points = Grid(0.0, 0.0, 1.0, SHAPE).nodes().reshape(-1, 2)
    normal, scene = solved(points, 4.0, 1e-6)
    torch.testing.assert_close(normal.image(scene, 1e-6)[0][INSIDE], scene[0][INSIDE], atol=1e-5, rtol=0)
    torch.testing.assert_close(scene[0], wave(normal.grid.nodes(), 4.0), atol=1e-3, rtol=0)


def test_an_image_is_as_sharp_between_its_nodes_as_at_them():
    normal, scene = solved(everywhere(), 4.0, 1e-4)
    image = SplineImage(
        scene=normal.image(scene, 1e-4),
        grid=normal.grid,
        known=torch.ones(SHAPE, dtype=torch.bool),
        reach=3.0,
        fill=False,
        homographies=np.eye(3)[None],
        black=0.0,
    )
    between = normal.grid.nodes()[INSIDE] + 0.5
    drawn = image.render(between.numpy().astype(np.float64), 0)[..., 0]
    assert np.sqrt(np.mean((drawn - wave(between, 4.0).numpy()) ** 2)) < 0.05 * 0.3


def test_an_image_of_nothing_is_finite():
    normal = NormalEquations.empty(Grid(0.0, 0.0, 1.0, SHAPE), 1.3, 3, torch.device("cpu"))
    assert torch.isfinite(normal.image(normal.solve(0.1), 0.1)).all()


def test_a_solution_is_the_exact_one_to_a_part_of_its_finest_detail():
    # Faint detail on bright ground, through a footprint that passes a third of it.
    generator = torch.Generator().manual_seed(0)
    grid, smoothness = Grid(0.0, 0.0, 1.0, SHAPE), 0.01
    points = torch.rand(3000, 2, generator=generator) * torch.tensor([SHAPE[1] - 1, SHAPE[0] - 1])
    values = 0.8 + 0.01 * (wave(points, 5.0) - 0.5) + 0.005 * torch.randn(3000, generator=generator)
    empty = NormalEquations.empty(grid, 2.0, 1, torch.device("cpu"))
    normal = empty.with_samples(points, values[:, None], torch.ones(3000))
    nodes = torch.eye(SHAPE[0] * SHAPE[1]).reshape(-1, *SHAPE)
    matrix = normal.through(normal.stencil(normal.through(nodes))) + smoothness * normal.prior(nodes)
    exact = torch.linalg.solve(matrix.flatten(1).double(), normal.through(normal.rhs).flatten().double())
    solution = normal.solve(smoothness, iterations=200)[0]
    left = (solution - exact.reshape(SHAPE))[INSIDE]
    assert float(left.std()) < 0.05 * float(exact.reshape(SHAPE)[INSIDE].std())


def test_a_scene_is_black_in_the_dark_and_as_it_was_where_samples_have_looked():
    points = everywhere(3)
    points = points[points[:, 0] < 30]
    grid = Grid(0.0, 0.0, 1.0, SHAPE)
    normal = NormalEquations.empty(grid, 1.3, 1, torch.device("cpu"))
    normal = normal.with_samples(points, (points[:, :1] / 30 - 0.2).clamp_min(0), torch.ones(len(points)))
    dark = grid.nodes()[..., 0] > 32
    light, black = (equations.solve(0.1, iterations=300)[0] for equations in (normal, normal.darkened(dark, 2.0)))
    assert float(light[:, 50].min()) > 0.2
    assert float(black[:, 50].abs().max()) < 0.05
    torch.testing.assert_close(black[:, :24], light[:, :24], atol=0.01, rtol=0)


def test_a_scene_without_samples_is_black_in_the_dark():
    normal = NormalEquations.empty(Grid(0.0, 0.0, 1.0, SHAPE), 1.3, 1, torch.device("cpu"))
    assert not normal.darkened(torch.ones(SHAPE, dtype=torch.bool), 2.0).solve(0.1).any()
