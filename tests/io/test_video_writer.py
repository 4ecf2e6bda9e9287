"""Videos out: what comes back of them, frame by frame."""

import sys
from dataclasses import replace

import av
import numpy as np
import pytest

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.video_writer import write_video

SHAPE = (61, 83)


class Stack:
    """Reads frames of an array, one at a time."""

    def __init__(self, frames):
        self.frames, self.most = frames, 0

    def __call__(self, numbers):
        self.most = max(self.most, len(numbers))
        return self.frames[list(numbers)]


def source_of(frames, times=None, white=None):
    frames = frames if frames.ndim == 4 else frames[..., None]
    known = Acquisition(
        shape=frames.shape,
        axes="TYXC" if frames.shape[3] > 1 else "TYX",
        dtype=frames.dtype,
        black_level=0.0,
        white_level=float(white or np.iinfo(frames.dtype).max),
        times=None if times is None else np.asarray(times, float),
    )
    return FrameSource(acquisition=known, reader=Stack(frames), name="frames", fingerprint="0")


def smooth(count, channels=1, dtype=np.uint8, most=255):
    y, x = np.indices(SHAPE)
    waves = [
        0.5 + 0.4 * np.cos(x / (7 + 2 * band) + 0.3 * number) * np.sin(y / (9 - band))
        for number in range(count)
        for band in range(channels)
    ]
    frames = np.rint(most * np.reshape(waves, (count, channels, *SHAPE))).astype(dtype)
    return np.moveaxis(frames, 1, -1)


def read(path, layout):
    with av.open(path) as file:
        frames = list(file.decode(video=0))
        rate = file.streams.video[0].average_rate
    stack = np.stack([frame.to_ndarray(format=layout) for frame in frames])
    return stack, np.array([float(frame.time) for frame in frames]), rate


@pytest.mark.parametrize("ending", [".avi", ".mkv"])
@pytest.mark.parametrize(
    ("channels", "dtype", "most", "layout"),
    [(1, np.uint8, 255, "gray"), (3, np.uint8, 255, "rgb24"), (1, np.uint16, 4095, "gray16le")],
)
def test_ffv1_gives_every_bit_back(tmp_path, rng, ending, channels, dtype, most, layout):
    frames = rng.integers(0, most + 1, (5, *SHAPE, channels)).astype(dtype)
    source = source_of(frames, times=np.arange(5) / 12.5)
    path = write_video(source, tmp_path / f"a{ending}")
    back, times, rate = read(path, layout)
    np.testing.assert_array_equal(back.reshape(frames.shape), frames)
    np.testing.assert_allclose(times, np.arange(5) / 12.5, atol=1e-3)
    assert rate == 12.5
    assert source.reader.most == 1  # however long the recording is, one frame is in memory
    assert [item.name for item in tmp_path.iterdir()] == [f"a{ending}"]


@pytest.mark.parametrize(("channels", "layout"), [(1, "gray"), (3, "rgb24")])
@pytest.mark.parametrize(("name", "codec", "error"), [("a.avi", "mjpeg", 2.5), ("a.mp4", None, 4.5)])
def test_lossy_codecs_come_close(tmp_path, channels, layout, name, codec, error):
    frames = smooth(6, channels)
    back, times, _ = read(write_video(source_of(frames), tmp_path / name, codec=codec), layout)
    np.testing.assert_allclose(times, np.arange(6) / 25, atol=1e-4)
    back = back.reshape(*back.shape[:3], channels).astype(float)
    assert np.abs(back[:, :61, :83] - frames).mean() < error
    if name == "a.mp4":
        assert back.shape[1:3] == (62, 84)
        assert np.abs(back[:, 61, :83] - frames[:, 60]).mean() < 2 * error


def test_16_bits_become_8_by_their_levels_where_a_codec_has_no_more(tmp_path):
    frames = smooth(3, dtype=np.uint16, most=1023)
    path = write_video(source_of(frames, white=1023), tmp_path / "a.avi", codec="mjpeg")
    back, _, _ = read(path, "gray")
    assert np.abs(back - frames[..., 0] * (255 / 1023)).mean() < 2.5


def test_uneven_times_are_kept_where_the_container_can(tmp_path):
    times = np.array([2.0, 2.1, 2.35, 2.4])
    source = source_of(smooth(4), times=times)
    for name in ("a.mkv", "a.mp4"):
        _, back, _ = read(write_video(source, tmp_path / name), "gray")
        np.testing.assert_allclose(back, times - 2, atol=1e-3)
    with pytest.raises(OutputError, match=r"an \.avi file cannot hold the uneven times"):
        write_video(source, tmp_path / "a.avi")
    _, back, rate = read(write_video(source, tmp_path / "a.avi", rate=50), "gray")
    np.testing.assert_allclose(back, np.arange(4) / 50)
    assert rate == 50


def test_frames_are_counted_as_they_are_written(tmp_path):
    counted = []
    write_video(source_of(smooth(4)), tmp_path / "a.avi", on_frame=lambda: counted.append(1))
    assert len(counted) == 4


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.mov", {}, r"a file ending in \.avi, \.mkv, \.mp4; got"),
        ("a.avi", {"codec": "vp9"}, "unknown codec 'vp9'; known: ffv1, mjpeg, h264"),
        ("a.mp4", {"codec": "ffv1"}, "FFV1 does not go into .mp4"),
        ("a.avi", {"rate": 0}, "rate must be above 0 frames per second; got 0"),
        ("none/a.avi", {}, "the folder .* does not exist"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, name, options, message):
    with pytest.raises(OutputError, match=message):
        write_video(source_of(smooth(2)), tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_two_channels_and_times_that_fall_are_refused(tmp_path):
    with pytest.raises(OutputError, match="a video has 1 or 3 channels; frames has 2"):
        write_video(source_of(smooth(2, channels=2)), tmp_path / "a.avi")
    with pytest.raises(OutputError, match="do not rise"):
        write_video(source_of(smooth(3), times=[0, 2, 1]), tmp_path / "a.mkv")


def test_a_recording_that_breaks_off_leaves_no_file(tmp_path):
    whole = source_of(smooth(4))

    def broken(numbers):
        if 2 in numbers:
            raise OSError("the disk is gone")
        return whole.recorded(numbers)

    with pytest.raises(OutputError, match="the disk is gone"):
        write_video(replace(whole, reader=broken), tmp_path / "a.avi")
    assert not list(tmp_path.iterdir())


def test_without_pyav_it_is_said_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(OutputError, match=r"pip install 'napari-fiberburst\[recordings\]'"):
        write_video(source_of(smooth(2)), tmp_path / "a.avi")
