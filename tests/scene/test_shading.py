"""Slow changes of the illumination are told from the object by its motion; where there are none, none are found."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from napari_fiberburst import Registration, Samples
from napari_fiberburst.scene.shading import find_shading, shading_of_frames

SHAPE, PITCH, FRAMES = (93, 111), 5.0, 12


def lattice():
    """Return the cores of a hexagonal bundle that fills the frame, (N, 2)."""
    y, x = np.mgrid[2 : SHAPE[0] - 2 : PITCH * 0.75**0.5, 2 : SHAPE[1] - 2 : PITCH]
    x = x + np.arange(len(x))[:, None] % 2 * PITCH / 2
    points = np.stack([x, y], axis=-1).reshape(-1, 2)
    return points[points[:, 0] < SHAPE[1] - 1]


CORES = lattice()
MIDDLE = (np.array(SHAPE[::-1]) - 1) / 2
EVEN = np.zeros((len(CORES), 1))
# Threefold from the middle to the corners.
VIGNETTE = -np.log(3) * ((CORES - MIDDLE) ** 2).sum(axis=1, keepdims=True) / (MIDDLE**2).sum()
SLOPE = 0.6 * (CORES[:, :1] - MIDDLE[0]) / MIDDLE[0]


def moving(step, seed=0):
    """Return homographies of shifts that are drawn from a normal distribution, pixels."""
    found = np.tile(np.eye(3), (FRAMES, 1, 1))
    found[1:, :2, 2] = np.random.default_rng(seed).normal(0, step, (FRAMES - 1, 2))
    return found


def seen(log_shading, motion, *, noise=0.005, exposures=None, gain_variance=0.04):
    """Return samples of a smooth object under a shading (N, C), and the registration that is known of them."""
    rng = np.random.default_rng(1)
    waves = rng.normal(0, 2 * np.pi / 25, (20, 2))
    phases = rng.uniform(0, 2 * np.pi, 20)
    points = CORES[None] + motion[:, None, :2, 2]
    light = 0.4 * np.exp(0.12 * np.sin(points @ waves.T + phases).sum(axis=-1))
    exposures = np.ones(FRAMES) if exposures is None else exposures
    values = exposures[:, None, None] * light[..., None] * np.exp(log_shading)[None]
    values = values + rng.normal(0, noise, values.shape)
    samples = Samples(
        kind="cores",
        positions=torch.from_numpy(CORES).float(),
        values=torch.from_numpy(values).float(),
        weights=torch.ones(FRAMES, len(CORES)),
        core_index=torch.arange(len(CORES)),
        cores=len(CORES),
        radius=0.36 * PITCH,
        shape=SHAPE,
        pitch=PITCH,
        gain_variance=gain_variance,
    )
    return samples, Registration.known(motion, SHAPE, len(CORES))


def error(found, log_shading):
    """Return the standard deviation of what is wrong with the logarithm of each channel's shading, (C,)."""
    return (found.gains.double().log().numpy() - log_shading).std(axis=0)


def test_a_threefold_vignette_is_found_to_a_few_per_cent():
    found = find_shading(*seen(VIGNETTE, moving(6.0)))
    assert VIGNETTE.std() > 0.2
    assert (error(found, VIGNETTE) < 0.03).all()


def test_each_channel_has_its_own_shading():
    shading = np.concatenate([0.8 * VIGNETTE, EVEN, -0.5 * VIGNETTE], axis=1)
    found = find_shading(*seen(shading, moving(6.0)))
    assert found.gains.shape == shading.shape
    assert (error(found, shading) < 0.03).all()


def test_a_slope_is_found_where_exposures_are_steady():
    assert error(find_shading(*seen(SLOPE, moving(6.0))), SLOPE) < 0.05


def test_median_gain_is_one():
    found = find_shading(*seen(VIGNETTE, moving(6.0)))
    assert float(found.gains.median()) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_found_in_even_light(seed):
    assert find_shading(*seen(EVEN, moving(6.0, seed))) is None


def test_nothing_is_found_in_even_light_that_flickers():
    exposures = np.exp(np.random.default_rng(2).normal(0, 0.05, FRAMES))
    samples, registration = seen(EVEN, moving(6.0), exposures=exposures)
    found = find_shading(samples, registration)
    assert found is None or error(found, EVEN) < 0.02


def test_nothing_is_found_where_the_object_hardly_moves():
    assert find_shading(*seen(VIGNETTE, moving(0.05))) is None


def test_nothing_is_found_in_too_little_light():
    assert find_shading(*seen(0.3 * VIGNETTE, moving(6.0), noise=0.5)) is None


def test_nothing_is_looked_for_where_there_is_no_bundle():
    assert find_shading(*seen(VIGNETTE, moving(6.0), gain_variance=0.0)) is None


def test_mean_frame_of_an_even_object_shows_the_shading():
    samples, _ = seen(VIGNETTE, moving(0.0))
    light = torch.from_numpy(np.exp(VIGNETTE)).float().expand(FRAMES, -1, -1)
    assert error(shading_of_frames(replace(samples, values=light)), VIGNETTE) < 0.03
