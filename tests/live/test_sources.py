"""Live sources on a clock that goes on only when it is told to."""

from dataclasses import replace

import numpy as np
import pytest

from napari_fiberburst import FiberBurstError
from napari_fiberburst.io import open_recording
from napari_fiberburst.live.clocks import RealClock, SimulatedClock
from napari_fiberburst.live.sources import Replay


def stack(count=12):
    """Frames (T, 17, 23), each of its own number."""
    return np.arange(count, dtype=np.uint8)[:, None, None] + np.zeros((1, 17, 23), np.uint8)


def replay(count=12, rate=10.0):
    return Replay(open_recording(stack(count)), rate, SimulatedClock())


def test_whoever_keeps_up_gets_every_frame_when_it_is_taken():
    source = replay()
    for number in range(12):
        got = source.latest()
        assert (got.indices.tolist(), got.dropped) == ([number], 0)
        assert got.frames.shape == (1, 17, 23, 1)
        assert (got.frames == number).all()
        assert got.times[0] == pytest.approx(number / 10)
        assert source.clock.now() == pytest.approx(number / 10, abs=1e-5)
        source.clock.wait(0.03)


def test_the_newest_frame_wins_and_those_passed_over_are_counted():
    source = replay()
    assert source.latest().indices.tolist() == [0]
    source.clock.wait(0.37)  # 1, 2 and 3 have come
    got = source.latest()
    assert (got.indices.tolist(), got.dropped) == ([3], 2)
    source.clock.wait(0.4)  # 4 to 7
    got = source.latest(3)
    assert (got.indices.tolist(), got.dropped) == ([5, 6, 7], 1)
    assert got.times.tolist() == pytest.approx([0.5, 0.6, 0.7])
    assert got.frames[:, 0, 0, 0].tolist() == [5, 6, 7]


def test_frames_that_were_handed_out_do_not_come_again():
    source = replay()
    source.clock.wait(5.0)  # it begins when it is first asked
    assert source.latest(4).indices.tolist() == [0]
    assert source.latest(4).indices.tolist() == [1]


def test_after_the_last_frame_there_is_none_and_all_are_accounted_for():
    source, seen, dropped = replay(), 0, 0
    while len((got := source.latest()).frames):
        seen, dropped = seen + 1, dropped + got.dropped
        source.clock.wait(0.25)
    assert got.frames.shape == (0, 17, 23, 1)
    assert got.dropped == 0
    assert seen + dropped == 12
    assert dropped > 0
    assert len(source.latest().frames) == 0


def test_a_real_clock_hands_out_every_frame_that_there_is_time_for():
    source = Replay(open_recording(stack(3)), 200.0, RealClock())
    first = source.latest()
    rest = [source.latest(3) for _ in range(2)]
    assert first.indices.tolist() == [0]
    assert sum(len(got.frames) for got in rest) == 2
    assert sum(got.dropped for got in rest) == 0


def test_a_recording_tells_its_own_rate():
    untimed = open_recording(stack())
    timed = replace(untimed, acquisition=replace(untimed.acquisition, times=np.arange(12) * 0.04))
    assert Replay(timed).rate == pytest.approx(25)


def test_rates_and_numbers_that_cannot_be_are_refused():
    with pytest.raises(FiberBurstError, match="does not tell how many frames it has a second; give a rate"):
        Replay(open_recording(stack()))
    for rate in (0, -3, float("nan"), float("inf")):
        with pytest.raises(FiberBurstError, match=f"a rate above 0 frames a second; got {rate}"):
            replay(rate=rate)
    with pytest.raises(FiberBurstError, match="ask for 1 frame or more; got 0"):
        replay().latest(0)
