"""Burst: what it takes, what it holds, what it refuses."""

import dask.array as da
import numpy as np
import pytest

from napari_fiberburst import Burst
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.errors import BurstError


def stack(rng, shape=(3, 17, 23), dtype=np.uint8, high=256):
    return rng.integers(0, high, shape).astype(dtype)


def test_grey_frames_gain_a_channel_axis_and_lose_it_on_the_way_back(rng):
    frames = stack(rng)
    burst = Burst(frames)
    assert burst.frames.shape == burst.shape == (3, 17, 23, 1)
    assert burst.frames.dtype == np.float32
    assert burst.axes == "TYX"
    np.testing.assert_allclose(burst.in_original_units(burst.frames[1]), frames[1], atol=1e-4)


@pytest.mark.parametrize("channels", [1, 3, 7, 31])
def test_any_number_of_channels(rng, channels):
    frames = stack(rng, (2, 16, 19, channels))
    burst = Burst(frames)
    assert burst.shape == frames.shape
    assert burst.in_original_units(burst.frames[0]).shape == (16, 19, channels)


@pytest.mark.parametrize(
    ("dtype", "high", "white"),
    [
        (np.uint8, 256, 255),
        (np.uint16, 900, 1023),
        (np.uint16, 4000, 4095),
        (np.uint16, 60000, 65535),
        (np.uint32, 2**32, 2**32),
    ],
)
def test_integers_are_scaled_by_the_full_scale_that_holds_them(rng, dtype, high, white):
    frames = stack(rng, dtype=dtype, high=high)
    frames[0, 0, 0] = high - 1
    burst = Burst(frames)
    assert (burst.black_level, burst.white_level) == (0, white)
    np.testing.assert_allclose(burst.frames[..., 0], frames / white, atol=1e-6)


def test_floats_are_taken_as_zero_to_one_or_wider(rng):
    assert Burst(rng.random((2, 16, 16)) * 0.5).white_level == 1
    wide = rng.random((2, 16, 16)) * 50 - 3
    burst = Burst(wide)
    assert burst.frames.min() == 0
    assert burst.frames.max() == 1
    np.testing.assert_allclose(burst.in_original_units(burst.frames[0]), wide[0], atol=1e-4)


def test_levels_can_be_set_and_what_lies_beyond_is_clipped(rng):
    frames = stack(rng)
    burst = Burst(frames, black_level=10, white_level=100)
    np.testing.assert_allclose(burst.frames[..., 0], np.clip((frames - 10.0) / 90, 0, 1), atol=1e-6)
    with pytest.raises(BurstError, match="below the white level"):
        Burst(frames, black_level=9, white_level=9)


def test_axes_name_another_order(rng):
    frames = stack(rng, (3, 4, 17, 23))
    burst = Burst(frames, axes="CTYX")
    assert burst.shape == (4, 17, 23, 3)
    np.testing.assert_allclose(burst.frames[2, :, :, 1] * 255, frames[1, 2], atol=1e-4)
    np.testing.assert_array_equal(Burst(frames[:, :, None], axes="CTZYX").frames, burst.frames)


def test_dask_gives_the_same_as_numpy(rng):
    frames = stack(rng, (3, 17, 23, 3), np.uint16, 4000)
    lazy = Burst(da.from_array(frames, chunks=(1, 8, 8, 3)))
    np.testing.assert_array_equal(lazy.frames, Burst(frames).frames)
    assert lazy.dtype == np.uint16


def test_a_list_of_frames_is_a_burst(rng):
    frames = stack(rng)
    np.testing.assert_array_equal(Burst(list(frames)).frames, Burst(frames).frames)


def test_micro_has_one_spelling(rng):
    greek, micro = "\N{GREEK SMALL LETTER MU}m", "\N{MICRO SIGN}m"
    assert Burst(stack(rng, (3, 17, 23)), pixel_size=0.63, unit=greek).unit == micro


def test_what_is_known_of_the_recording_is_kept(rng):
    burst = Burst(
        stack(rng, (3, 17, 23, 2)), channel_names=["red", "blue"], pixel_size=0.63, unit="µm", times=[0, 0.1, 0.3]
    )
    assert burst.channel_names == ("red", "blue")
    assert burst.pixel_size == (0.63, 0.63)
    assert burst.nbytes == 3 * 17 * 23 * 2
    again = Acquisition.from_dict(burst.acquisition.to_dict())
    assert again.to_dict() == burst.acquisition.to_dict()
    np.testing.assert_array_equal(again.times, [0, 0.1, 0.3])


def test_a_crop_remembers_where_it_was(rng):
    frames = stack(rng, (3, 40, 50))
    part = Burst(frames).crop((5, 25), (7, 40)).crop((1, 18), (2, 20))
    assert part.shape == (3, 17, 18, 1)
    assert part.origin == (6, 9)
    np.testing.assert_allclose(part.frames[..., 0] * 255, frames[:, 6:23, 9:27], atol=1e-4)


@pytest.mark.parametrize("rows", [(-1, 20), (0, 41), (20, 20), (30, 20)])
def test_a_crop_outside_the_image_is_refused(rng, rows):
    with pytest.raises(BurstError, match="within 0:40"):
        Burst(stack(rng, (3, 40, 50))).crop(rows, (0, 50))


@pytest.mark.parametrize(("black", "white"), [(-1e98, 0), (0, 1e40), (-1e-60, 0), (7, 7 + 1e-60)])
def test_levels_that_float32_does_not_tell_apart_are_refused(rng, black, white):
    with pytest.raises(BurstError, match=r"below the white level, both between -3e38 and 3e38"):
        Burst(stack(rng), black_level=black, white_level=white)


def test_a_crop_too_small_is_refused(rng):
    with pytest.raises(BurstError, match="at least 16 pixels"):
        Burst(stack(rng, (3, 40, 50))).crop((0, 15), (0, 50))


def test_levels_and_crops_that_leave_nothing_to_see_are_refused(rng):
    frames = stack(rng, (3, 40, 50))
    frames[:, :20] = 0
    with pytest.raises(BurstError, match="every frame is constant"):
        Burst(frames).crop((0, 20), (0, 50))
    with pytest.raises(BurstError, match="every frame is constant"):
        Burst(frames, black_level=254.5, white_level=1000).crop((0, 20), (0, 50))


@pytest.mark.parametrize(
    ("image", "axes", "shape"), [((17, 23), None, (1, 17, 23, 1)), ((17, 23, 3), "YXC", (1, 17, 23, 3))]
)
def test_one_image_is_a_burst_of_one_frame(rng, image, axes, shape):
    burst = Burst(stack(rng, image), axes=axes)
    assert burst.shape == shape
    assert burst.axes == "TYX" + ("C" if shape[3] > 1 else "")


def bad_frames():
    ramp = np.arange(3 * 20 * 20.0).reshape(3, 20, 20)
    yield "a number", 3.0, "a list of frames, or a path; got 3.0"
    yield "ragged", [ramp[0], ramp[1, :-1]], r"shapes \(19, 20\), \(20, 20\); crop them to one size"
    yield "five axes", ramp[:, :, :, None, None], 'axes="CTYX"'
    yield "NaN", np.where(ramp == 450, np.nan, ramp), "frame 1 holds NaN or infinity"
    yield "infinity", np.where(ramp == 450, np.inf, ramp), "finite"
    yield "all the same", np.ones((3, 20, 20)), "every frame is constant"
    yield "constant frames", np.broadcast_to(np.arange(3.0)[:, None, None], (3, 20, 20)), "every frame is constant"
    yield "complex", ramp + 1j, "got complex128"
    yield "bool", ramp > 9, "got bool"
    yield "object", ramp.astype(object), "got object"
    yield "text", np.full((3, 20, 20), "a"), "integers or floats"
    yield "short side", ramp[:, :15], "at least 16 pixels a side, got 15 x 20"
    yield "nothing", np.zeros((0, 20, 20)), "at least one frame, got none"


@pytest.mark.parametrize(("frames", "said"), [pytest.param(*case[1:], id=case[0]) for case in bad_frames()])
def test_bad_frames_are_refused(frames, said):
    with pytest.raises(BurstError, match=said):
        Burst(frames)


def test_bad_axes_are_refused(rng):
    frames = stack(rng, (2, 3, 20, 20))
    for axes, said in (
        ("TYX", "shape"),
        ("TTYX", "shape"),
        ("CZYX", "axis Z of CZYX must have length 1, got 3"),
        ("TZYX", "length 1, got 3"),
    ):
        with pytest.raises(BurstError, match=said):
            Burst(frames, axes=axes)


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"channel_names": ["a", "b"]}, "one name for each of the 1 channels"),
        ({"pixel_size": 0}, "positive"),
        ({"pixel_size": (1, float("nan"))}, "positive"),
        ({"times": [0, 1]}, "one finite time for each of the 3 frames"),
        ({"times": "abc"}, "must be numbers"),
        ({"pixel_size": (1, 2, 3)}, "one number or"),
        ({"pixel_size": "a"}, "one number or"),
        ({"black_level": "dark"}, "must be numbers"),
        ({"axes": ("T", "Y", "X")}, "one letter per axis"),
    ],
)
def test_bad_metadata_is_refused(rng, known, said):
    with pytest.raises(BurstError, match=said):
        Burst(stack(rng), **known)
