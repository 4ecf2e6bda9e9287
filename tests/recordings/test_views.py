"""Small images of frames: what they read from cores, by arithmetic."""

import numpy as np
import pytest
import torch

from napari_fiberburst.recordings.views import Views, _regression, grid_of, middle_of

SHAPE, PITCH = (61, 83), 5.0


@pytest.fixture
def cores(rng):
    """Return cores where chance has put them, (N, 2), which is much less even than a bundle."""
    return rng.uniform(0, 1, (450, 2)) * (SHAPE[1] - 1, SHAPE[0] - 1)


def read(cores, light, used=None):
    grid = grid_of(SHAPE, PITCH)
    used = np.ones(len(cores), bool) if used is None else used
    operator, known = _regression(grid, cores, used, 0.55 * PITCH)
    return (operator @ light).reshape(grid.shape), known, grid.nodes().double().numpy()


def test_an_even_light_is_read_as_it_is(cores):
    seen, known, _ = read(cores, np.full(len(cores), 0.7))
    np.testing.assert_allclose(seen[known], 0.7, atol=1e-5)
    np.testing.assert_array_equal(seen[~known], 0)
    assert known.mean() > 0.9


def test_planes_are_read_where_they_are_and_not_where_the_cores_happen_to_lie(cores):
    slope = np.array([0.02, -0.013])
    seen, known, nodes = read(cores, cores @ slope + 0.4)
    off = (seen - nodes @ slope - 0.4)[known]
    away = cores[:, None] - nodes[known][None]
    weight = np.exp(-(away**2).sum(axis=2) / 2 / (0.55 * PITCH) ** 2)
    by_weights = (weight * (cores @ slope + 0.4)[:, None]).sum(axis=0) / weight.sum(axis=0) - nodes[known] @ slope - 0.4
    assert np.sqrt(np.mean(off**2)) < 0.35 * np.sqrt(np.mean(by_weights**2))


def test_cores_that_are_not_used_have_no_part(cores):
    used = np.arange(len(cores)) % 5 > 0
    light = np.where(used, 0.3, 99.0)
    seen, known, _ = read(cores, light, used)
    np.testing.assert_allclose(seen[known], 0.3, atol=1e-5)


def test_nothing_is_known_far_from_all_cores(cores):
    left = cores[cores[:, 0] < 40]
    _, known, nodes = read(left, np.ones(len(left)))
    assert not known[nodes[..., 0] > 47].any()
    assert known[(nodes[..., 0] > 4) & (nodes[..., 0] < 36)].mean() > 0.9


def test_the_middle_is_that_of_the_images():
    grid = grid_of(SHAPE, PITCH)
    np.testing.assert_allclose(middle_of(SHAPE, PITCH), grid.nodes().reshape(-1, 2).double().numpy().mean(axis=0))


def test_views_are_even_and_do_not_follow_the_exposure(located):
    views = Views(located.traces)
    image, mask = views.at(3)
    assert image.shape == mask.shape == views.shape
    assert mask.float().mean() > 0.9
    inner = views.inner(3) > 0
    assert bool((~mask & inner).any()) is False
    assert abs(float(image[inner].mean())) < 0.1
    assert 0.3 < float(image[inner].std()) < 3
    assert torch.isfinite(image).all()
