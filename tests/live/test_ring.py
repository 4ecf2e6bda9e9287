"""Frames kept while they are taken, and handed out to whoever watches."""

from threading import Thread

import numpy as np
import pytest

from napari_fiberburst import FiberBurstError
from napari_fiberburst.io import open_recording
from napari_fiberburst.live.clocks import SimulatedClock
from napari_fiberburst.live.ring import Ring
from napari_fiberburst.live.sources import Latest, Replay


def come(*numbers, shape=(17, 23), dropped=0):
    """Return frames of their own numbers, ten a second."""
    frames = np.array(numbers, np.uint8)[:, None, None, None] + np.zeros((*shape, 1), np.uint8)
    return Latest(frames=frames, indices=np.array(numbers), times=np.array(numbers) / 10, dropped=dropped)


def test_frames_of_the_last_seconds_are_kept_and_older_ones_forgotten():
    ring = Ring(SimulatedClock(), seconds=0.5)
    for number in range(20):
        ring.put(come(number))
    assert ring.last(100).frames[:, 0, 0, 0].tolist() == [14, 15, 16, 17, 18, 19]
    kept = ring.last(0.25)
    assert kept.frames[:, 0, 0, 0].tolist() == [17, 18, 19]
    assert kept.times.tolist() == pytest.approx([1.7, 1.8, 1.9])
    assert ring.count == 20


def test_no_more_bytes_are_kept_than_asked_for():
    ring = Ring(SimulatedClock(), seconds=100, most_bytes=3 * 17 * 23)
    ring.put(come(*range(9)))
    assert ring.last(100).frames[:, 0, 0, 0].tolist() == [6, 7, 8]


def test_a_slow_watcher_gets_the_newest_and_the_ring_all():
    ring = Ring(SimulatedClock())
    ring.put(come(0))
    assert ring.latest().indices.tolist() == [0]
    ring.put(come(1, 2, 3))
    got = ring.latest()
    assert (got.indices.tolist(), got.dropped) == ([3], 2)
    ring.put(come(4, 5, dropped=2))
    assert ring.latest(9).indices.tolist() == [4, 5]
    assert (len(ring.last(100).frames), ring.lost) == (6, 2)


def test_a_whole_replay_is_kept_by_a_thread_of_its_own_and_the_watcher_hears_of_its_end():
    frames = np.arange(40, dtype=np.uint8)[:, None, None] + np.zeros((17, 23), np.uint8)
    ring = Ring(SimulatedClock())
    thread = Thread(target=ring.record, args=(Replay(open_recording(frames), 10.0, SimulatedClock()),))
    thread.start()
    seen = dropped = 0
    while len((got := ring.latest()).frames):
        seen, dropped = seen + 1, dropped + got.dropped
    thread.join()
    assert seen + dropped == ring.count == 40
    assert (ring.lost, ring.problem) == (0, "")


def test_a_camera_that_changes_ends_it_and_the_frames_before_are_kept():
    class Changing:
        clock = SimulatedClock()
        closed = False

        def __init__(self):
            self.given = [come(0, 1), come(2, shape=(19, 23))]

        def latest(self, n=1):
            return self.given.pop(0)

        def close(self):
            self.closed = True

    ring, source = Ring(Changing.clock), Changing()
    ring.record(source)
    assert "changed from 17 x 23 pixels of uint8 to 19 x 23 pixels of uint8; the frames before are kept" in ring.problem
    assert source.closed
    assert ring.last(9).frames.shape == (2, 17, 23, 1)
    assert ring.latest().indices.tolist() == [1]
    assert len(ring.latest().frames) == 0


def test_a_driver_that_fails_is_told():
    class Failing:
        clock = SimulatedClock()

        def latest(self, n=1):
            raise RuntimeError("unplugged")

        def close(self):
            pass

    ring = Ring(Failing.clock)
    ring.record(Failing())
    assert ring.problem == "RuntimeError: unplugged"


def test_a_ring_that_could_keep_nothing_is_refused():
    with pytest.raises(FiberBurstError, match="more than 0 seconds; got 0 s"):
        Ring(SimulatedClock(), seconds=0)
