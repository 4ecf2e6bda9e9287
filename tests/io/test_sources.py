"""Recordings of any kind: what is read of them, and when."""

import os
import pickle

import dask.array as da
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
import zarr
from tests.io.clips import clip, drawn, number_of, write_clip

from napari_fiberburst import FrameSource, find_doubled, open_recording, read_burst
from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.tiff import _OpenTiff


@pytest.fixture
def frames(rng):
    return rng.integers(0, 4096, (24, 17, 23)).astype(np.uint16)


class Counting:
    """An array that counts the frames that are asked of it at a time; made up, and never in memory."""

    shape, dtype = (100_000, 19, 31), np.dtype(np.uint16)

    def __init__(self):
        self.asked = []

    def __getitem__(self, key):
        numbers = range(self.shape[0])[key]
        self.asked.append(len(numbers))
        first = np.array(numbers)[:, None, None] % 4000
        return (first + np.arange(31) + np.zeros((19, 1), int)).astype(self.dtype)


def assert_holds(source, frames):
    expected = frames[..., None] if frames.ndim == 3 else frames
    assert isinstance(source, FrameSource)
    assert source.shape == expected.shape
    assert source.acquisition.dtype == frames.dtype
    np.testing.assert_array_equal(source.recorded(range(len(frames))), expected)
    np.testing.assert_array_equal(source.recorded([len(frames) - 1, 0]), expected[[-1, 0]])
    copy = pickle.loads(pickle.dumps(source))
    np.testing.assert_array_equal(copy.recorded([1]), expected[[1]])


def test_no_more_is_read_than_a_window_needs():
    array = Counting()
    source = open_recording(array)
    assert sum(array.asked) <= 20  # levels and fingerprint
    array.asked.clear()
    assert source.recorded(range(70_000, 70_015)).shape == (15, 19, 31, 1)
    source.take(range(0, 100_000, 25_000)).burst([0, 3])
    assert sum(array.asked) == 15 + 2
    assert (source.acquisition.black_level, source.acquisition.white_level) == (0, 4095)


def test_levels_go_by_a_sample_and_can_be_given(rng):
    values = rng.integers(0, 900, (64, 17, 19)).astype(np.uint16)
    assert open_recording(values).acquisition.white_level == 1023
    values[63, 3, 4] = 5000  # the last frame is always in the sample
    assert open_recording(values).acquisition.white_level == 16383
    given = open_recording(values, black_level=10, white_level=800).acquisition
    assert (given.black_level, given.white_level) == (10, 800)
    floats = rng.normal(0, 1, (8, 17, 19)).astype(np.float32)
    known = open_recording(floats).acquisition
    assert (known.black_level, known.white_level) == (floats.min(), floats.max())
    with pytest.raises(BurstError, match="below the white level"):
        open_recording(values, black_level=9, white_level=8)


@pytest.mark.parametrize("axes", ["TYX", "YXT", "TYXC", "CTYX", "TZYX", "YX"])
def test_axes_in_any_order(rng, axes):
    lengths = {"T": 7, "Y": 17, "X": 23, "C": 2, "Z": 1}
    array = rng.integers(0, 255, [lengths[axis] for axis in axes], dtype=np.uint8)
    order = [axes.index(axis) for axis in "ZTYXC" if axis in axes]
    expected = array.transpose(order).reshape(
        lengths["T"] if "T" in axes else 1, 17, 23, lengths["C"] if "C" in axes else 1
    )
    for kind in (array, da.from_array(array, chunks=5)):
        source = open_recording(kind, axes=axes)
        np.testing.assert_array_equal(source.recorded(range(len(source))), expected)


def tiff_kinds(frames):
    yield "plain", {"photometric": "minisblack"}
    yield "compressed", {"photometric": "minisblack", "compression": "zlib"}
    yield "imagej", {"imagej": True, "metadata": {"axes": "TYX"}}
    yield "big-endian", {"photometric": "minisblack", "byteorder": ">"}
    yield "ome", {"ome": True, "metadata": {"axes": "TYX"}, "photometric": "minisblack", "compression": "lzw"}


@pytest.mark.parametrize("kind", ["plain", "compressed", "imagej", "big-endian", "ome"])
def test_pages_of_a_tiff_are_read_one_by_one(tmp_path, frames, kind, monkeypatch):
    tifffile.imwrite(tmp_path / "a.tif", frames, **dict(tiff_kinds(frames))[kind])
    read = []
    page = _OpenTiff.read
    monkeypatch.setattr(_OpenTiff, "read", lambda tiff, number: (read.append(number), page(tiff, number))[1])
    source = open_recording(tmp_path / "a.tif")
    read.clear()
    source.recorded([5, 11])
    assert read == [5, 11]
    assert_holds(source, frames)


def test_channels_that_are_pages_are_read_with_their_frame(tmp_path, rng):
    frames = rng.integers(0, 255, (6, 2, 17, 23), dtype=np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", frames, ome=True, metadata={"axes": "TCYX"}, photometric="minisblack")
    assert_holds(open_recording(tmp_path / "a.tif"), np.moveaxis(frames, 1, 3))
    tifffile.imwrite(tmp_path / "b.tif", frames, photometric="minisblack")
    assert_holds(open_recording(tmp_path / "b.tif", axes="TCYX"), np.moveaxis(frames, 1, 3))


def test_a_folder_a_pattern_and_a_list_of_images(tmp_path, frames):
    for index, frame in enumerate(frames):
        iio.imwrite(tmp_path / f"{index}.png", frame)
    paths = [tmp_path / f"{index}.png" for index in range(len(frames))]
    for recording in (tmp_path, str(tmp_path / "*.png"), paths):
        assert_holds(open_recording(recording), frames)
    iio.imwrite(tmp_path / "7.png", frames[7, :16])
    source = open_recording(tmp_path)
    source.recorded([6, 8])
    with pytest.raises(BurstError, match=r"all frames need one size and type; .*7\.png has \(16, 23\)"):
        source.recorded([7])


def test_ome_zarr_is_sliced(tmp_path, frames):
    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="w")
    group.create_array("0", data=frames, chunks=(5, 17, 23))
    axes = [{"name": name, "type": "time" if name == "t" else "space"} for name in "tyx"]
    group.attrs["ome"] = {"multiscales": [{"axes": axes, "datasets": [{"path": "0"}]}]}
    assert_holds(open_recording(tmp_path / "a.zarr"), frames)


def test_an_archive(tmp_path, frames):
    np.savez(tmp_path / "a.npz", frames=frames, white_level=5000)
    source = open_recording(tmp_path / "a.npz")
    assert_holds(source, frames)
    assert source.acquisition.white_level == 5000


def test_several_files_are_one_recording(tmp_path):
    paths = [tmp_path / f"{part}.mkv" for part in range(3)]
    starts, counts = (0, 30, 50), (30, 20, 25)
    for path, start, count in zip(paths, starts, counts, strict=True):
        write_clip(path, "ffv1", "gray", [drawn(start + number) for number in range(count)])
    for recording in (paths, [str(path) for path in paths], tmp_path, str(tmp_path / "*.mkv")):
        source = open_recording(recording)
        assert len(source) == 75
        wanted = [74, 3, 31, 29, 50, 49]
        assert [number_of(frame[..., 0]) for frame in source.recorded(wanted)] == wanted
        np.testing.assert_allclose(np.diff(source.acquisition.times), 0.04, atol=1e-9)
    tifffile.imwrite(tmp_path / "other.tif", np.zeros((3, 17, 23), np.uint8), photometric="minisblack")
    with pytest.raises(BurstError, match=r"frames of one size and type; .*other\.tif has 17 x 23, .* has 50 x 70"):
        open_recording([*paths, tmp_path / "other.tif"])


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ("5:9", range(5, 9)),
        ("2:20:5", range(2, 20, 5)),
        (":3", range(3)),
        ("-4:", range(20, 24)),
        ("20:900", range(20, 24)),
        ("9:5:-1", range(9, 5, -1)),
        (slice(3, None, 7), range(3, 24, 7)),
    ],
)
def test_frames_are_chosen_as_python_slices(tmp_path, frames, expected, request):
    values = np.random.default_rng(0).integers(0, 4096, (24, 17, 23)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack")
    burst = read_burst(tmp_path / "a.tif", frames=frames)
    np.testing.assert_allclose(burst.frames[..., 0] * burst.white_level, values[list(expected)], atol=1e-2)
    source = open_recording(tmp_path / "a.tif", frames=frames)
    np.testing.assert_array_equal(source.recorded(range(len(source)))[..., 0], values[list(expected)])


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ("100", 'a slice such as "100:120" or "100:200:5"; got \'100\''),
        ("a:b", "must be a slice"),
        ("1:2:3:4", "must be a slice"),
        ("1.5:3", "must be a slice"),
        ("1:9:0", "must be a slice"),
        (7, "must be a slice"),
        ([1, 2], "must be a slice"),
        (slice("a"), "must be a slice"),
        ("30:40", "has 24 frames, 0 to 23, and none of them is in 30:40"),
    ],
)
def test_frames_that_are_no_slice_are_refused(frames, said):
    with pytest.raises(BurstError, match=said):
        open_recording(np.zeros((24, 17, 23), np.uint8), frames=frames)


def test_only_the_frames_of_a_burst_are_read(tmp_path, frames):
    for index, frame in enumerate(frames):
        iio.imwrite(tmp_path / f"{index}.png", frame)
    (tmp_path / "9.png").write_text("damaged")
    assert read_burst(tmp_path, frames="10:20").shape == (10, 17, 23, 1)
    with pytest.raises(BurstError, match=r"9\.png cannot be read as an image"):
        read_burst(tmp_path, frames="5:20")


def test_the_fingerprint_is_anothers_where_the_frames_may_be(tmp_path, frames):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, frames, photometric="minisblack")
    source = open_recording(path)
    assert open_recording(path).fingerprint == source.fingerprint
    assert open_recording(path, white_level=4000).fingerprint != source.fingerprint
    assert open_recording(path, frames="1:").fingerprint != source.fingerprint
    os.utime(path, (1, 1))
    assert open_recording(path).fingerprint != source.fingerprint
    assert open_recording(frames).fingerprint == open_recording(frames.copy()).fingerprint
    assert open_recording(frames).fingerprint != open_recording(frames + np.uint16(1)).fingerprint


class Broken:
    shape, dtype = (9, 17, 23), np.dtype(np.uint8)

    def __getitem__(self, key):
        raise KeyError("the disk is gone")


@pytest.mark.parametrize(
    ("recording", "said"),
    [
        (3, "a path, a list of paths, or an array .* got int"),
        ([np.zeros((20, 20))], "one array by numpy.stack"),
        ([], "got list"),
        (np.zeros((3, 20, 30), bool), "integers or floats, got bool"),
        (np.zeros((3, 9, 30)), "at least 16 pixels a side"),
        (np.zeros((0, 20, 30)), "at least one frame"),
        (np.zeros((3, 20, 30, 3, 2)), "got shape"),
        (Broken(), r"frames 0 to 0 of the array cannot be read \(KeyError: 'the disk is gone'\)"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_what_is_no_recording_is_refused(recording, said):
    with pytest.raises(BurstError, match=said):
        open_recording(recording).recorded(range(4))


def with_noise(number, until):
    """Return a frame of a scene that moves until some number, with noise of its own."""
    scene = drawn(min(number, until), (50, 80)).astype(float)
    noise = np.random.default_rng(number).normal(0, 2, scene.shape)
    return np.clip(scene + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "options", "until"),
    [
        # Where the scene stands still from frame 18 on, noise alone tells frames apart.
        ("a.mkv", "ffv1", "gray", {}, 18),
        ("a.avi", "mjpeg", "yuvj420p", {"qmin": "3", "qmax": "3"}, 18),
        ("a.mp4", "libx264", "yuv420p", {"bf": "2", "g": "60", "crf": "20"}, 99),
    ],
)
def test_doubled_frames_are_found_and_no_others(tmp_path, name, codec, pixels, options, until):
    doubled = [4, 5, 11, 30, 31, 37]
    shown = np.cumsum([number not in doubled for number in range(45)]).tolist()
    frames = [with_noise(number, until) for number in shown]
    source = open_recording(write_clip(tmp_path / name, codec, pixels, frames, options=options))
    assert find_doubled(source).tolist() == doubled


def test_a_recording_at_a_third_of_the_rate_is_two_thirds_doubled(rng):
    frames = rng.integers(0, 255, (20, 17, 23), dtype=np.uint8).repeat(3, axis=0)
    expected = [number for number in range(60) if number % 3]
    assert find_doubled(open_recording(frames)).tolist() == expected


def test_the_first_frame_is_never_doubled():
    assert find_doubled(open_recording(np.zeros((1, 17, 23), np.uint8))).tolist() == []


def test_a_source_is_opened_as_itself(tmp_path):
    source = open_recording(clip(tmp_path, "ffv1", 10))
    assert open_recording(source) is source
    assert len(open_recording(source, frames="2:5")) == 3
