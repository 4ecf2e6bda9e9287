"""A core has a gain in each place of a bundle that moves, and one gain in the end."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.joint import _slope
from napari_fiberburst.motion.places import (
    places_with_gains,
    split_by_place,
    with_common_gains,
    with_gains_by_place,
)
from napari_fiberburst.motion.registration import unregistered

PLACES = np.array([0, 0, 0, 1, 1, 1, 1])


@pytest.fixture
def samples():
    generator = torch.Generator().manual_seed(2)
    return Samples(
        kind="cores",
        positions=60 * torch.rand(31, 2, generator=generator),
        values=0.2 + torch.rand(7, 31, 3, generator=generator),
        weights=torch.rand(7, 31, generator=generator),
        core_index=torch.arange(31),
        cores=31,
        radius=1.7,
        shape=(57, 63),
        pitch=5.0,
        gain_variance=0.04,
    )


def test_places_with_few_frames_share_the_gains_of_the_one_with_most():
    assert places_with_gains(np.array([0] * 4 + [1] * 6 + [2] * 3)).tolist() == [1] * 4 + [0] * 6 + [0] * 3
    assert places_with_gains(np.arange(9)).tolist() == [0] * 9


def test_a_burst_of_many_places_is_split_into_few():
    assert places_with_gains(np.repeat(np.arange(11), 5)).max() == 3


def test_every_sample_is_in_one_place(samples):
    split = split_by_place(samples, PLACES)
    weights = split.weights.reshape(7, 2, 31)
    torch.testing.assert_close(weights.sum(dim=1), samples.weights)
    assert not weights[:3, 1].any()
    assert not weights[3:, 0].any()
    assert split.core_index.tolist() == list(range(62))


def test_what_places_differ_by_is_taken_out_of_the_samples(samples):
    rng = np.random.default_rng(5)
    common = rng.uniform(0.7, 1.3, 31).astype(np.float32)
    by_place = rng.uniform(0.95, 1.05, (2, 31)).astype(np.float32)
    by_place /= np.exp(np.average(np.log(by_place), axis=0, weights=[3, 4]))
    shown = replace(samples, values=samples.values * torch.from_numpy(by_place[PLACES])[..., None])
    found = with_gains_by_place(unregistered(shown), PLACES)
    found = replace(found, gains=(found.gains.reshape(2, 31) * common * by_place).ravel())
    found, even = with_common_gains(found, shown, PLACES)
    np.testing.assert_allclose(found.gains, common, rtol=1e-5)
    torch.testing.assert_close(even.values, samples.values)


def test_frames_that_are_darker_where_the_bundle_has_moved_tell_no_slope_of_the_gains():
    rng = np.random.default_rng(3)
    places, gains = torch.from_numpy(rng.uniform(-50, 50, (90, 2))), torch.from_numpy(rng.normal(0, 0.1, 90))
    shifts = torch.from_numpy(np.cumsum(rng.normal(0, 3, (12, 2)), axis=0))
    groups = torch.arange(12) // 6
    even, darker = torch.zeros(12).double(), -0.01 * groups.double()
    told = _slope(places, gains, shifts, even, groups, 0.02)
    torch.testing.assert_close(_slope(places, gains, shifts, darker, groups, 0.02), told)
    one = torch.zeros(12, dtype=torch.int64)
    assert (_slope(places, gains, shifts, darker, one, 0.02) - told).norm() > 1e-5
