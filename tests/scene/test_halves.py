"""Halves of a burst that show one scene agree, and those that do not are told apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.scene.halves import disagreement

SHAPE = (87, 111)


def scene_at(points, shift=0.0):
    x, y = points[..., 0] + shift, points[..., 1]
    return 0.5 + 0.2 * torch.sin(x / 9) * torch.cos(y / 7)


@pytest.fixture
def burst():
    """Return samples of one smooth scene along a walk of twelve frames, and where they lie."""
    rng = np.random.default_rng(0)
    positions = torch.from_numpy(rng.uniform((0, 0), SHAPE[::-1], (700, 2))).float()
    walk = torch.from_numpy(np.cumsum(rng.normal(0, 2.0, (12, 1, 2)), axis=0)).float()
    points = positions + walk
    values = scene_at(points)[..., None]
    samples = Samples(
        kind="cores",
        positions=positions,
        values=values,
        weights=torch.ones(12, 700),
        core_index=torch.arange(700),
        cores=700,
        radius=1.5,
        shape=SHAPE,
        pitch=4.0,
        gain_variance=0.04,
    )
    return samples, points


def test_halves_of_one_scene_agree_but_for_their_noise(burst):
    samples, points = burst
    still = disagreement(samples, points, np.arange(12))
    noisy = samples.values + 0.05 * torch.randn(samples.values.shape, generator=torch.Generator().manual_seed(0))
    assert still < 0.02
    assert still < disagreement(replace(samples, values=noisy), points, np.arange(12)) < 0.06


def test_an_object_that_moves_on_halfway_is_told(burst):
    samples, points = burst
    values = samples.values.clone()
    values[6:] = scene_at(points[6:], shift=4.0)[..., None]
    changed = disagreement(replace(samples, values=values), points, np.arange(12))
    assert changed > 3 * disagreement(samples, points, np.arange(12))
    # Its size is that of the mean's error.
    assert changed == pytest.approx(float((scene_at(points) - scene_at(points, shift=4.0)).std()) / 2, rel=0.3)


def test_a_change_of_brightness_is_no_disagreement(burst):
    samples, points = burst
    values = samples.values.clone()
    values[6:] += 0.1
    brighter = disagreement(replace(samples, values=values), points, np.arange(12))
    assert brighter < disagreement(samples, points, np.arange(12)) + 0.01


def test_frames_that_are_left_out_take_no_part(burst):
    samples, points = burst
    points = points.clone()
    points[[3, 8]] = torch.nan
    values = samples.values.clone()
    values[[3, 8]] = 0
    used = np.array([0, 1, 2, 4, 5, 6, 7, 9, 10, 11])
    assert disagreement(replace(samples, values=values), points, used) < 0.02


def test_halves_that_do_not_overlap_say_nothing(burst):
    samples, points = burst
    points = points.clone()
    points[6:] += 300
    assert np.isnan(disagreement(samples, points, np.arange(12)))
    assert np.isnan(disagreement(samples, points, np.arange(1)))
