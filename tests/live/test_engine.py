"""The live engine beside what simulated recordings say of themselves."""

from functools import lru_cache
from gc import collect
from itertools import cycle
from threading import Event
from threading import enumerate as enumerate_threads
from time import sleep

import numpy as np
import pytest
from scipy.spatial import cKDTree

from napari_fiberburst import Bundle, FiberBurstError, LiveEngine
from napari_fiberburst.quality import match_levels, psnr
from napari_fiberburst.simulation import simulate_recording

SHAPE = (141, 167)


@lru_cache
def recorded(channels=1, **more):
    return simulate_recording(
        frames=40, shape=SHAPE, pitch=5.0, path="handheld", step=2.0, channels=channels, seed=3, **more
    )


def bundle_of(recording):
    return Bundle.from_image(np.rint(np.clip(recording.transmission * 255, 0, 255)).astype(np.uint8))


def frames_of(recording, numbers=range(40)):
    frames = recording.source.recorded(numbers)
    return frames if frames.shape[3] > 1 else frames[..., 0]


def quality(image, truth):
    inner = (slice(12, -12), slice(12, -12))
    image, truth = (part.reshape(*SHAPE, -1)[inner] for part in (image, truth))
    assert np.isfinite(image).all()
    return psnr(match_levels(image, truth), truth)


def test_the_picture_gets_sharper_with_every_frame():
    recording = recorded()
    engine = LiveEngine(bundle_of(recording))
    views = [engine.push(frame) for frame in frames_of(recording)]
    early, late = (quality(views[number].image, recording.truth([number])[0]) for number in (0, 39))
    assert late > 28
    assert late > early + 5
    assert {view.state for view in views} == {"following"}
    assert views[0].advice == "move a little"
    assert views[-1].advice == "fine"
    assert views[-1].image.dtype == np.float32
    assert np.isfinite(views[-1].image[12:-12, 12:-12]).all()


def test_frames_lie_where_they_were():
    recording = recorded()
    engine = LiveEngine(bundle_of(recording))
    views = [engine.push(frame) for frame in frames_of(recording)]
    middle = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2, 1])
    off = [
        np.linalg.norm((view.homography @ middle - truth @ middle)[:2])
        for view, truth in zip(views, recording.homographies, strict=True)
    ]
    assert max(off) < 1.0
    assert np.ptp(off[20:]) < 0.3


def test_colour_is_followed():
    recording = recorded(channels=3)
    engine = LiveEngine(bundle_of(recording))
    views = [engine.push(frame) for frame in frames_of(recording, range(20))]
    assert views[-1].image.shape == (*SHAPE, 3)
    assert quality(views[-1].image, recording.truth([19])[0]) > 26


def test_without_a_bundle_it_calibrates_itself():
    recording = recorded()
    engine = LiveEngine(waits=True)
    views = [engine.push(frame) for frame in frames_of(recording)]
    assert [view.state for view in views] == ["calibrating"] * 19 + ["following"] * 21
    assert views[0].advice == "wait"
    assert engine.bundle is not None
    assert quality(views[-1].image, recording.truth([39])[0]) > 28


def test_while_it_calibrates_the_picture_has_no_honeycomb():
    recording = recorded()
    frame, truth = frames_of(recording, [0])[0], recording.truth([0])[0]
    image = LiveEngine().push(frame).image
    assert image.dtype == np.float32
    assert quality(image, truth) > quality(frame.astype(np.float32), truth) + 0.5
    plain = np.add.outer(np.arange(SHAPE[0]), np.arange(SHAPE[1])).astype(np.uint16)
    assert np.array_equal(LiveEngine().push(plain).image, plain)


def test_the_bundle_of_a_calibration_is_near_the_one_behind_the_frames():
    recording = recorded()
    engine = LiveEngine(waits=True)
    for frame in frames_of(recording, range(20)):
        engine.push(frame)
    found, known = engine.bundle, bundle_of(recording)
    distance, number = cKDTree(known.centres).query(found.centres)
    same = distance < 0.2 * known.pitch
    assert same.mean() > 0.97
    ratio = found.brightness[same] / known.brightness[number[same]]
    ratio /= np.median(ratio)
    assert 1.48 * np.median(np.abs(ratio - 1)) < 0.03


def test_frames_go_on_while_it_calibrates(monkeypatch):
    recording, may_end = recorded(), Event()
    known = bundle_of(recording)

    def held(burst):
        while not may_end.is_set():
            yield
        return known

    monkeypatch.setattr("napari_fiberburst.live.calibration.measuring", held)
    with LiveEngine() as engine:
        frames = cycle(frames_of(recording))
        assert {engine.push(next(frames)).state for _ in range(60)} == {"calibrating"}
        may_end.set()
        while engine.push(next(frames)).state == "calibrating":
            sleep(0.001)
        assert engine.bundle is known


def test_nothing_runs_once_it_is_closed(monkeypatch):
    def endless(burst):
        while True:
            yield

    monkeypatch.setattr("napari_fiberburst.live.calibration.measuring", endless)
    before, frames = set(enumerate_threads()), frames_of(recorded())
    with LiveEngine() as engine:
        for frame in frames[:25]:
            engine.push(frame)
        assert set(enumerate_threads()) > before
    assert set(enumerate_threads()) == before
    with pytest.raises(FiberBurstError, match="this live engine was closed and takes no more frames; begin a new one"):
        engine.push(frames[25])


def test_an_engine_that_is_forgotten_ends_by_itself(monkeypatch):
    begun, ended = Event(), Event()

    def endless(burst):
        begun.set()
        try:
            while True:
                yield
        finally:
            ended.set()

    monkeypatch.setattr("napari_fiberburst.live.calibration.measuring", endless)
    engine = LiveEngine()
    for frame in frames_of(recorded(), range(25)):
        engine.push(frame)
    assert begun.wait(60)
    assert not ended.is_set()
    del engine
    collect()
    assert ended.wait(60)


def test_frames_that_show_nothing_are_calibrated_by_others_later():
    recording = recorded()
    engine = LiveEngine(waits=True)
    black = [np.full(SHAPE, number % 2, np.uint8) for number in range(20)]
    assert {engine.push(frame).state for frame in black} == {"calibrating"}
    views = [engine.push(frame) for frame in frames_of(recording, range(20))]
    assert views[-1].state == "following"


def test_calibration_waits_for_a_second_where_times_are_given():
    recording = recorded()
    engine = LiveEngine(waits=True)
    views = [engine.push(frame, 7 + number / 30) for number, frame in enumerate(frames_of(recording))]
    assert [view.state for view in views] == ["calibrating"] * 30 + ["following"] * 10
    assert [view.seconds for view in views] == [7 + number / 30 for number in range(40)]


def test_a_clock_that_is_set_back_does_not_hold_up_calibration():
    recording = recorded()
    engine = LiveEngine(waits=True)
    frames = frames_of(recording)
    for frame in frames[:3]:
        engine.push(frame, 1000.0)
    views = [engine.push(frame, number / 20) for number, frame in enumerate(frames[3:25])]
    assert views[-1].state == "following"


def test_lost_contact_is_told_and_it_comes_back():
    recording = recorded()
    engine = LiveEngine(bundle_of(recording))
    frames = frames_of(recording)
    for frame in frames[:15]:
        engine.push(frame)
    black = [np.full_like(frames[0], value) for value in (1, 2)]
    assert {(view.state, view.advice) for view in map(engine.push, black)} == {("lost", "out of contact")}
    back = engine.push(frames[15])
    assert back.state == "following"
    assert back.piece == 0


def test_another_place_begins_a_new_scene_at_its_second_frame():
    recording, other = recorded(), recorded(jumps=1)
    cut = int(other.cuts[0])
    assert 1 < cut < 38
    engine = LiveEngine(bundle_of(recording))
    frames = frames_of(other)
    views = [engine.push(frame) for frame in frames]
    assert views[cut].state == "lost"
    assert views[cut + 1].state == "following"
    assert views[cut + 1].piece == 1
    assert views[-1].piece == 1


def test_frozen_and_white_frames_are_told_at_once():
    recording = recorded()
    engine = LiveEngine(bundle_of(recording))
    frames = frames_of(recording)
    engine.push(frames[0])
    before = engine.push(frames[1])
    frozen = engine.push(frames[1])
    assert (frozen.state, frozen.advice) == ("frozen", "the camera has stopped")
    assert np.array_equal(frozen.image, before.image, equal_nan=True)
    white = engine.push(np.full_like(frames[0], 255))
    assert (white.state, white.advice) == ("lost", "too bright")
    assert engine.push(frames[2]).state == "following"


def test_light_that_dims_is_told_and_followed():
    recording = recorded()
    engine = LiveEngine(bundle_of(recording))
    frames = frames_of(recording).astype(np.float32) / 255
    for frame in frames[:10]:
        engine.push(frame)
    dim = engine.push(0.7 * frames[10])
    assert dim.state == "following"
    assert dim.brightness == pytest.approx(0.7, abs=0.03)


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 4.0])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_exposure_that_jumps_is_followed(factor, dtype):
    recording = recorded()
    engine = LiveEngine(bundle_of(recording))
    # Such light that four times as much of it, or a quarter, is within 16 bits, and the first frames within 10.
    frames = (frames_of(recording, range(24)) * np.float32(4)).astype(dtype)
    before = [engine.push(frame) for frame in frames[:20]]
    after = [engine.push((frame * factor).astype(dtype)) for frame in frames[20:]]
    assert {(view.state, view.piece) for view in (*before, *after)} == {("following", 0)}
    levels = [np.nanmedian(views[at].image) for views, at in ((before, -1), (after, 0))]
    assert levels[1] / levels[0] == pytest.approx(factor, rel=0.1)
    assert quality(after[-1].image, recording.truth([23])[0]) > 26


def test_another_bit_depth_begins_a_new_scene():
    recording = recorded()
    engine = LiveEngine(bundle_of(recording))
    frames = frames_of(recording)
    for frame in frames[:20]:
        engine.push(frame)
    deep = [engine.push(frame.astype(np.uint16) * 16) for frame in frames[20:]]
    assert {(view.state, view.piece) for view in deep} == {("following", 1)}
    assert deep[0].advice == "move a little"
    assert np.array_equal(deep[0].homography, np.eye(3))
    assert quality(deep[-1].image, recording.truth([39])[0]) > 28


def test_pixels_that_are_nan_are_left_out():
    recording = recorded()
    engine = LiveEngine(bundle_of(recording))
    frames = frames_of(recording).astype(np.float32) / 255
    for frame in frames[:10]:
        engine.push(frame)
    broken = frames[10].copy()
    broken[40:60, 50:80] = np.nan
    assert np.isfinite(engine.push(broken).image[12:-12, 12:-12]).all()
    assert engine.push(np.full_like(broken, np.nan)).state == "lost"
    assert engine.push(frames[11]).state == "following"


def test_what_cannot_be_taken_is_refused_and_live_view_goes_on():
    recording = recorded()
    engine = LiveEngine(bundle_of(recording))
    frames = frames_of(recording)
    engine.push(frames[0])
    with pytest.raises(FiberBurstError, match="frames were 141 x 167, but this one is 100 x 167"):
        engine.push(frames[1][:100])
    with pytest.raises(FiberBurstError, match=r"a live frame is \(H, W\)"):
        engine.push(np.zeros(5))
    with pytest.raises(FiberBurstError, match="the time of a live frame must be finite, in seconds; got nan"):
        engine.push(frames[1], float("nan"))
    assert engine.push(frames[1]).state == "following"
    with pytest.raises(FiberBurstError, match="the bundle was measured in frames of 141 x 167"):
        LiveEngine(bundle_of(recording)).push(frames[0][:100])
    with pytest.raises(FiberBurstError, match="the half-life must be a positive number of frames; got 0"):
        LiveEngine(half_life=0)
