"""Places count once, however long a probe has rested there."""

import numpy as np
import pytest
import torch
from tests.recordings.conftest import SHAPE, after_similarity, middles

from napari_fiberburst.recordings.locate import locating
from napari_fiberburst.recordings.places import mean_over_places
from napari_fiberburst.simulation import simulate_recording
from napari_fiberburst.steps import drain

CORES = 400


@pytest.fixture
def rested():
    """Return gains, and what cores have seen: 60 places, of which one in 300 frames more, with noise and flicker."""
    rng = np.random.default_rng(0)
    gains = rng.uniform(0.8, 1.2, CORES)
    shown = rng.uniform(0.5, 1.5, (60, CORES))
    order = np.concatenate([np.arange(30), np.full(300, 30), np.arange(30, 60)])
    seen = gains * shown[order] * rng.uniform(0.7, 1.3, (len(order), 1)) + rng.normal(0, 0.02, (len(order), CORES))
    return gains, torch.from_numpy(seen).float()


def spread(mean, gains):
    return float(np.std(np.log(mean.numpy() / gains)))


def test_rest_leaves_no_object_in_the_mean(rested):
    gains, seen = rested
    weights = torch.ones(CORES)
    mean = mean_over_places(lambda number: (seen[number], weights), np.arange(len(seen)))
    assert spread(seen.mean(dim=0), gains) > 0.2
    assert spread(mean, gains) < 0.06


def test_only_frames_that_are_named_count_and_cores_that_saw_nothing_have_none(rested):
    _, seen = rested
    seen, weights = seen.clone(), torch.ones(CORES)
    seen[5], weights[7] = 1e6, 0
    mean = mean_over_places(lambda number: (seen[number], weights), np.delete(np.arange(len(seen)), 5))
    assert mean[7] == 0
    assert 0 < float(mean.max()) < 3


def test_nothing_shown_is_a_mean_of_nothing(rested):
    _, seen = rested
    mean = mean_over_places(lambda number: (seen[number], torch.ones(CORES)), np.zeros(0, int))
    assert mean.shape == (CORES,)
    assert not mean.any()


def test_a_probe_that_rests_for_most_of_a_recording_is_placed_all_along(tmp_path):
    way = simulate_recording(frames=60, shape=SHAPE, path="handheld", step=5.0, seed=4).homographies
    rest = np.tile(way[30], (90, 1, 1))
    rest[:, :2, 2] += np.random.default_rng(1).normal(0, 0.15, (90, 2))
    truth = simulate_recording(shape=SHAPE, frames=150, path=np.concatenate([way[:30], rest, way[30:]]), seed=4)
    located = drain(locating(truth.source, tmp_path, bundle=None, dof=None, client=None))
    assert (located.track.piece == 0).all()
    assert located.quality == "good"
    found, true = middles(located.track.scene_from_frame), middles(truth.homographies)
    assert np.median(np.abs(after_similarity(found, true)[0] - true)) < 0.1
