"""Which part of a recording is chosen as a burst, against recordings of which one part suits."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_fiberburst import best_burst, open_recording
from napari_fiberburst.errors import BurstError
from napari_fiberburst.simulation import simulate

SHAPE, PART = (121, 143), 40
# Pixels a frame: about two and a half pitches in a burst of twenty frames.
SLOW = 0.6


@pytest.fixture(scope="module")
def parts():
    """Return frames of an object that stands still, moves, moves out of focus, in the dark, over-exposed, too fast."""
    steps = np.repeat([0, SLOW, SLOW, SLOW, SLOW, 12.0], PART)
    # There and back again, so that all parts show the same tissue.
    steps[2 * PART : 3 * PART] *= -1
    steps[4 * PART : 5 * PART] *= -1
    motion = np.tile(np.eye(3), (len(steps), 1, 1))
    motion[:, 0, 2] = np.cumsum(steps) - steps[0]
    simulated = simulate("histology", shape=SHAPE, frames=len(steps), channels=1, pitch=5.0, motion=motion, seed=4)
    truth = simulated.truth[..., 0].copy()
    truth[2 * PART : 3 * PART] = gaussian_filter(truth[2 * PART : 3 * PART], (0, 6, 6))
    truth[3 * PART : 4 * PART] *= 0.05
    truth[4 * PART : 5 * PART] *= 4
    noise = np.random.default_rng(0).normal(0, 0.01, truth.shape)
    frames = np.clip(truth * simulated.transmission + noise, 0, 1)
    names = ("still", "moving", "out of focus", "dark", "over-exposed", "too fast")
    cut = np.split((255 * frames).astype(np.uint8), len(names))
    return dict(zip(names, cut, strict=True))


@pytest.mark.parametrize("other", ["still", "out of focus", "dark", "over-exposed", "too fast"])
@pytest.mark.parametrize("is_first", [True, False])
def test_frames_that_move_in_contact_are_chosen(parts, other, is_first):
    order = [parts["moving"], parts[other]] if is_first else [parts[other], parts["moving"]]
    chosen = best_burst(open_recording(np.concatenate(order)))
    assert len(chosen) == 20
    first = 0 if is_first else PART
    assert first - 4 <= chosen.start
    assert chosen.stop <= first + PART + 4


def test_among_all_of_them_the_one_that_suits_is_chosen(parts):
    names = ["dark", "still", "out of focus", "moving", "too fast", "over-exposed"]
    chosen = best_burst(open_recording(np.concatenate([parts[name] for name in names])), frames=12)
    assert 3 * PART - 3 <= chosen.start
    assert chosen.stop <= 4 * PART + 6


def test_a_short_recording_is_a_burst():
    frames = np.random.default_rng(0).integers(0, 255, (20, 17, 23), dtype=np.uint8)
    assert best_burst(open_recording(frames)) == range(20)
    assert best_burst(open_recording(frames), frames=30) == range(20)


def test_a_recording_in_which_nothing_is_seen_has_a_burst_all_the_same():
    assert len(best_burst(open_recording(np.zeros((50, 33, 41), np.uint8)))) == 20


def test_few_frames_of_a_long_recording_are_read():
    class Long:
        shape, dtype = (100_000, 33, 41), np.dtype(np.uint8)
        read = 0

        def __getitem__(self, key):
            numbers = np.arange(self.shape[0])[key]
            Long.read += len(numbers)
            y, x = np.indices(self.shape[1:])
            return (100 + 50 * np.sin((x + numbers[:, None, None]) / 3) * np.cos(y / 2)).astype(np.uint8)

    chosen = best_burst(open_recording(Long()))
    assert 0 <= chosen.start < chosen.stop <= 100_000
    assert Long.read < 500


def test_a_burst_of_no_frames_is_refused(parts):
    with pytest.raises(BurstError, match="at least one frame; got 0"):
        best_burst(open_recording(parts["moving"]), frames=0)
