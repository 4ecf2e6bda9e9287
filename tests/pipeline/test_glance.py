"""What a burst looks like at a glance, against what the simulator has made of it."""

import numpy as np
import pytest

from napari_fiberburst import Burst
from napari_fiberburst.pipeline.glance import glance, some_of
from napari_fiberburst.simulation import simulate


def recorded(scene="histology", **more):
    view = {"shape": (141, 167), "frames": 8, "pitch": 5.0, "channels": 1, "physics": "core", "seed": 2}
    return simulate(scene, **{**view, **more})


def again(simulated, change):
    """Return a burst of the same frames, changed."""
    frames = simulated.burst.frames.copy()
    change(frames)
    return Burst(frames, axes="TYXC")


@pytest.mark.parametrize("scene", ["histology", "tissue", "retina"])
def test_pitch_and_travel_are_those_of_the_simulator(scene):
    simulated = recorded(scene)
    way = simulated.homographies[:, :2, 2] - simulated.homographies[0, :2, 2]
    seen = glance(simulated.burst)
    assert seen.pitch == pytest.approx(5.0, abs=0.1)
    assert seen.travel == pytest.approx(np.hypot(*way.T).max(), abs=5.0)
    assert seen.warnings == ()


def test_frames_that_do_not_move_are_warned_of():
    first = recorded().burst.frames[:1].repeat(8, axis=0)
    noise = np.random.default_rng(0).normal(0, 0.01, first.shape)
    seen = glance(Burst((first + noise).clip(0, 1).astype(np.float32), axes="TYXC"))
    assert seen.travel == 0
    assert any("gaps between cores stay" in warning for warning in seen.warnings)


def test_frames_without_a_bundle_are_warned_of():
    plain = np.random.default_rng(0).normal(0.5, 0.1, (6, 83, 97)).clip(0, 1).astype(np.float32)
    seen = glance(Burst(plain, axes="TYX"))
    assert seen.pitch is None
    assert "no bundle seen" in seen.words
    assert "No bundle is seen" in seen.warnings[0]


def test_blank_and_over_exposed_frames_are_counted():
    def spoil(frames):
        frames[2], frames[5] = 0, 1

    seen = glance(again(recorded(), spoil))
    assert (seen.blank, seen.unlike) == (2, 0)
    assert "2 of 8 frames are black" in " ".join(seen.warnings)


def test_saturated_pixels_are_warned_of():
    def overexpose(frames):
        np.minimum(2.5 * frames, 1, out=frames)

    seen = glance(again(recorded(), overexpose))
    assert seen.saturated > 0.01
    assert any("expose less" in warning for warning in seen.warnings)


def test_another_object_in_half_of_the_frames_is_warned_of():
    def replace(frames):
        frames[4:] = recorded("usaf", seed=7).burst.frames[4:]

    seen = glance(again(recorded(), replace))
    assert seen.unlike >= 3
    assert "show something else" in seen.warnings[0]


def test_one_frame_does_not_move():
    seen = glance(recorded(frames=1).burst)
    assert np.isnan(seen.travel)
    assert seen.words == "cores 5.0 px apart"


def test_few_frames_of_a_recording_and_the_middle_of_them_are_looked_at():
    numbers, rows, columns = some_of(2000, 1024, 300)
    assert (len(numbers), numbers[0], numbers[-1]) == (8, 0, 49)
    assert rows == (352, 672)
    assert columns == (0, 300)
    assert some_of(3, 40, 50) == ([0, 1, 2], (0, 40), (0, 50))
