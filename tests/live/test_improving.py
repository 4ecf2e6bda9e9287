"""Gains that are measured on while a live engine goes on, beside what the simulator knows of the bundle."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from napari_fiberburst import Bundle, LiveEngine
from napari_fiberburst.quality import match_levels, psnr
from napari_fiberburst.simulation import simulate_recording

SHAPE, FRAMES = (141, 167), 80


@lru_cache
def recorded():
    return simulate_recording(frames=FRAMES, shape=SHAPE, pitch=5.0, path="handheld", step=2.5, seed=3)


@lru_cache
def frames():
    return recorded().source.recorded(range(FRAMES))[..., 0]


@lru_cache
def known():
    return Bundle.from_image(np.rint(np.clip(recorded().transmission * 255, 0, 255)).astype(np.uint8))


@lru_cache
def off(by):
    """Return the bundle with gains that are off by so much, 1 sigma, and by what factors."""
    factors = np.random.default_rng(1).normal(1, by, len(known().centres)).astype(np.float32)
    return replace(known(), transmission=known().transmission * np.append(factors, np.float32(1))[known().labels])


def gain_error(bundle):
    ratio = bundle.brightness / known().brightness
    return 1.48 * np.median(np.abs(ratio / np.median(ratio) - 1))


def quality(view, number):
    inner = (slice(12, -12), slice(12, -12))
    image, truth = view.image[inner], recorded().truth([number])[0][..., 0][inner]
    return psnr(match_levels(image, truth), truth)


@lru_cache
def pushed(by, *, improves, weight=None):
    """Return an engine that has seen all frames, with its views."""
    bundle = off(by) if by else known()
    if weight is not None:
        bundle = replace(bundle, gain_weights=np.full_like(bundle.gain_weights, weight))
    engine = LiveEngine(bundle, improves=improves, waits=True)
    return engine, [engine.push(frame) for frame in frames()]


def test_gains_that_are_off_come_right_and_the_picture_with_them():
    engine, views = pushed(0.05, improves=True)
    fixed, as_before = pushed(0.05, improves=False)
    assert gain_error(engine.bundle) < 0.02 < 0.04 < gain_error(fixed.bundle)
    assert quality(views[-1], FRAMES - 1) > quality(as_before[-1], FRAMES - 1) + 3


def test_neither_place_nor_picture_jumps_when_gains_change():
    start = off(0.025)
    engine, views, changed = LiveEngine(start, waits=True), [], None
    for number, frame in enumerate(frames()):
        views.append(engine.push(frame))
        if changed is None and engine.bundle is not start:
            changed = number
    assert gain_error(engine.bundle) < 0.015
    middle = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2, 1])
    after = range(changed - 1, changed + 11)
    off_by = np.array([(views[number].homography - recorded().homographies[number]) @ middle for number in after])
    assert np.linalg.norm(np.diff(off_by, axis=0), axis=1).max() < 0.4
    assert {view.piece for view in views} == {0}
    assert np.diff([quality(views[number], number) for number in after]).min() > -1.0


def test_gains_that_have_held_the_frames_are_found_and_frames_move_again():
    engine, views = pushed(0.12, improves=True, weight=0)
    _, as_before = pushed(0.12, improves=False, weight=0)
    assert gain_error(engine.bundle) < 0.03
    assert quality(views[-1], FRAMES - 1) > quality(as_before[-1], FRAMES - 1) + 5


def test_a_bundle_that_is_right_stays_as_it_is():
    engine, views = pushed(0, improves=True)
    fixed, as_before = pushed(0, improves=False)
    assert engine.bundle is fixed.bundle is known()
    assert np.array_equal(views[-1].image, as_before[-1].image, equal_nan=True)
