"""Videos: every frame is the one that is asked for, and what is wrong with a file is said."""

import builtins
import pickle
from concurrent.futures import ProcessPoolExecutor
from fractions import Fraction
from multiprocessing import get_context
from threading import Thread

import av
import numpy as np
import pytest
from tests.io.clips import CLIPS, clip, drawn, number_of, write_clip

from napari_fiberburst import open_recording, read_burst
from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.video_decoder import Decoder

COUNT = 90


def numbers_in(source, numbers):
    return [number_of(frame[..., 0]) for frame in source.recorded(numbers)]


@pytest.mark.parametrize("kind", CLIPS)
def test_frames_are_those_that_are_asked_for(tmp_path, kind, rng):
    source = open_recording(clip(tmp_path, kind, COUNT))
    assert source.shape == (COUNT, 50, 70, 1)
    assert source.acquisition.dtype == np.uint8
    whole = source.recorded(range(COUNT))
    assert [number_of(frame[..., 0]) for frame in whole] == list(range(COUNT))
    for number in rng.permutation(COUNT)[:40].tolist():
        np.testing.assert_array_equal(source.recorded([number])[0], whole[number])
    mixed = rng.integers(0, COUNT, 12).tolist()
    assert numbers_in(source, mixed) == mixed
    backwards = range(COUNT - 1, COUNT - 20, -1)
    assert numbers_in(source, backwards) == list(backwards)


@pytest.mark.parametrize("kind", ["h264", "mpeg-1", "ffv1 in avi"])
def test_reading_on_decodes_each_frame_once(tmp_path, kind, monkeypatch):
    begun = []
    begin = Decoder._begin
    source = open_recording(clip(tmp_path, kind, COUNT))
    source.recorded([0])
    monkeypatch.setattr(Decoder, "_begin", lambda decoder, key: (begun.append(key), begin(decoder, key)))
    for number in range(1, COUNT):
        source.recorded([number])
    assert begun == []
    source.recorded([3])
    assert len(begun) == 1


def test_pixels_are_those_that_were_recorded(tmp_path, rng):
    grey = rng.integers(0, 256, (5, 51, 67), dtype=np.uint8)
    deep = rng.integers(0, 4000, (5, 51, 67)).astype(np.uint16)
    colour = rng.integers(0, 256, (5, 51, 67, 3), dtype=np.uint8)
    for frames, pixels in ((grey, "gray"), (deep, "gray16le"), (colour, "bgr0")):
        source = open_recording(write_clip(tmp_path / f"{pixels}.mkv", "ffv1", pixels, list(frames)))
        np.testing.assert_array_equal(source.recorded(range(5)).reshape(frames.shape), frames)
        assert source.acquisition.dtype == frames.dtype
        assert source.acquisition.axes == ("TYX" if frames.ndim == 3 else "TYXC")
        assert source.acquisition.black_level == 0
        assert source.acquisition.white_level == (4095 if frames.dtype == np.uint16 else 255)


def test_grey_of_ten_bits_keeps_them(tmp_path):
    frames = [drawn(number, full=1023) << 6 for number in range(5)]
    source = open_recording(write_clip(tmp_path / "a.mkv", "ffv1", "gray10le", frames))
    np.testing.assert_allclose(source.recorded([3])[0, ..., 0], frames[3] >> 6, atol=1)
    assert source.acquisition.white_level == 1023


@pytest.mark.parametrize(("name", "codec", "pixels"), [("a.avi", "mjpeg", "yuvj420p"), ("a.mp4", "libx264", "yuv420p")])
def test_colour_without_colours_is_grey_at_full_scale(tmp_path, name, codec, pixels):
    frames = [drawn(number) for number in range(8)]
    source = open_recording(write_clip(tmp_path / name, codec, pixels, frames))
    assert source.shape[3] == 1
    difference = source.recorded([5])[0, ..., 0].astype(int) - frames[5]
    assert abs(difference.mean()) < 1.5
    assert np.abs(difference).mean() < 6


def test_colour_that_comes_late_is_seen(tmp_path):
    frames = [np.repeat(drawn(number)[..., None], 3, axis=2) for number in range(40)]
    frames[-5:] = [frame * np.array([1, 0.6, 0.5]) for frame in frames[-5:]]
    frames = [frame.astype(np.uint8) for frame in frames]
    source = open_recording(write_clip(tmp_path / "a.avi", "mjpeg", "yuvj444p", frames))
    assert source.shape[3] == 3
    assert source.acquisition.axes == "TYXC"


def test_times_of_a_variable_rate_are_kept(tmp_path):
    at = np.cumsum([0, 40, 40, 120, 7, 33, 200, 40]).tolist()
    frames = [drawn(number) for number in range(8)]
    source = open_recording(write_clip(tmp_path / "a.mkv", "libx264", "yuv420p", frames, at=at))
    np.testing.assert_allclose(source.acquisition.times, np.array(at) / 1000, atol=1e-9)
    assert numbers_in(source, [6, 2]) == [6, 2]
    np.testing.assert_allclose(source.burst([6, 2]).times, [at[6] / 1000, at[2] / 1000])


def test_a_source_goes_to_another_process(tmp_path):
    source = open_recording(clip(tmp_path, "h264"))
    source.recorded([40])
    copy = pickle.loads(pickle.dumps(source))
    assert numbers_in(copy, [50, 7]) == [50, 7]
    assert copy.fingerprint == source.fingerprint
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        assert pool.submit(numbers_in, source, [77, 3]).result() == [77, 3]


def test_threads_do_not_get_each_others_frames(tmp_path, rng):
    source = open_recording(clip(tmp_path, "h264"))
    wrong = []

    def read(wanted):
        wrong.extend(number for number in wanted if numbers_in(source, [number]) != [number])

    threads = [Thread(target=read, args=(rng.permutation(COUNT)[:25].tolist(),)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


@pytest.mark.parametrize("kind", ["motion jpeg", "transport stream", "mpeg-1", "ffv1", "uncompressed", "mpeg-4 in avi"])
def test_a_file_that_was_cut_short_holds_what_is_left(tmp_path, kind, caplog, rng):
    name, codec, pixels, coded = CLIPS[kind]
    frames = [drawn(number, (122, 162)) for number in range(COUNT)]
    whole = write_clip(tmp_path / name, codec, pixels, frames, **coded)
    cut = whole.with_stem("cut")
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 7 // 10])
    source = open_recording(cut)
    assert COUNT // 3 < len(source) < COUNT * 0.85
    left = numbers_in(source, range(len(source)))
    assert left[:-3] == list(range(len(left) - 3))  # of the last group, some frames may be missing between others
    assert left == sorted(set(left))
    for number in rng.permutation(len(left))[:20].tolist():
        assert numbers_in(source, [number]) == [left[number]]


def test_an_mp4_that_was_cut_short_is_refused(tmp_path):
    path = clip(tmp_path, "h264")
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(BurstError, match=r"a\.mp4 cannot be read as video .* was cut short .* export it again"):
        open_recording(path)


def test_what_a_cut_file_has_lost_is_logged(tmp_path, caplog):
    path = clip(tmp_path, "motion jpeg")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    open_recording(path)
    assert "1 frames of" in caplog.text
    assert "parts of the file are missing" in caplog.text


def of_two_sizes(path):
    """Write ten frames of motion JPEG, of which the last four are narrower."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=25)
        narrow = av.CodecContext.create("mjpeg", "w")
        for coder, width in ((stream, 70), (narrow, 64)):
            coder.width, coder.height, coder.pix_fmt = width, 50, "yuvj420p"
        narrow.time_base = Fraction(1, 25)
        for number in range(10):
            frame = np.ascontiguousarray(drawn(number)[:, : 70 if number < 6 else 64])
            shown = av.VideoFrame.from_ndarray(frame, format="gray").reformat(format="yuvj420p")
            shown.pts = number
            for packet in (stream if number < 6 else narrow).encode(shown):
                packet.stream = stream
                container.mux(packet)
    return path


def test_frames_that_change_size_midway_are_refused_where_they_do(tmp_path):
    path = of_two_sizes(tmp_path / "a.avi")
    with pytest.raises(BurstError, match=r'frame 6 of .*a\.avi has 50 x 64 .* first has 50 x 70; .* frames="0:6"'):
        read_burst(path)
    assert read_burst(path, frames="0:6").shape == (6, 50, 70, 1)


def without_key_frames(path, tmp_path):
    """Take the packets between two key frames alone."""
    source = write_clip(tmp_path / "whole.mkv", "ffv1", "gray", [drawn(number) for number in range(20)])
    with av.open(str(source)) as whole, av.open(str(path), "w") as container:
        stream = container.add_stream_from_template(whole.streams.video[0])
        for packet in whole.demux(video=0):
            if packet.size and not packet.is_keyframe:
                packet.stream = stream
                container.mux(packet)


def of_sound(path):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.float32), format="fltp", layout="mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))


def test_files_that_hold_no_video_are_refused(tmp_path):
    without_key_frames(tmp_path / "no_keys.mkv", tmp_path)
    of_sound(tmp_path / "sound.mp4")
    (tmp_path / "empty.avi").write_bytes(b"")
    (tmp_path / "text.avi").write_text("not a video")
    whole = clip(tmp_path, "motion jpeg")
    (tmp_path / "codec.avi").write_bytes(whole.read_bytes().replace(b"MJPG", b"QQ9Z"))
    for name, said in (
        ("no_keys.mkv", "has no key frame, .* export it again with key frames"),
        ("sound.mp4", r"holds no pictures \(streams: 1 audio\); choose a file with a video stream"),
        ("empty.avi", "is empty; copy or export it again"),
        ("text.avi", "cannot be read as video"),
        ("codec.avi", "coded as QQ9Z, which PyAV .* pip install --upgrade av, or convert .* ffmpeg -i codec.avi"),
        ("none.avi", "there is no .*none.avi; expected .* a video"),
    ):
        for read in (open_recording, read_burst):
            with pytest.raises(BurstError, match=said):
                read(tmp_path / name)


def test_without_pyav_the_extra_is_named(tmp_path, monkeypatch):
    path = clip(tmp_path, "ffv1", 3)
    original = builtins.__import__

    def missing(name, *more):
        if name == "av":
            raise ImportError(name)
        return original(name, *more)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(BurstError, match=r"needs the package av; .* pip install 'napari-fiberburst\[recordings\]'"):
        open_recording(path)


def test_a_burst_is_read_from_a_video_by_its_frames(tmp_path):
    path = clip(tmp_path, "h264")
    burst = read_burst(path, frames="40:60:5")
    assert [number_of(frame[..., 0], full=1) for frame in burst.frames] == [40, 45, 50, 55]
    np.testing.assert_allclose(burst.times, np.array([40, 45, 50, 55]) / 25)


def test_a_recording_is_not_taken_for_a_burst(tmp_path):
    path = write_clip(tmp_path / "a.mkv", "ffv1", "gray", [drawn(number) for number in range(201)])
    with pytest.raises(
        BurstError, match=r'has 201 frames, .* frames="0:20" \(--frames 0:20\); fiberburst info .*a\.mkv offers'
    ):
        read_burst(path)
    assert read_burst(path, frames=":").shape[0] == 201
