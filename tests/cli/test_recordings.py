"""Long recordings on the command line."""

import numpy as np
import pytest
import tifffile
from tests.io.clips import drawn, write_clip

from napari_fiberburst import Bundle, open_recording, read_burst
from napari_fiberburst.cli import main
from napari_fiberburst.recordings import video
from napari_fiberburst.simulation import simulate


@pytest.fixture(scope="module")
def frames():
    """Return 70 frames of an object that moves by a third of a core distance from each to the next."""
    motion = np.tile(np.eye(3), (70, 1, 1))
    motion[:, 0, 2] = 1.5 * np.arange(70)
    simulated = simulate("histology", shape=(90, 122), frames=70, channels=1, pitch=5.0, motion=motion)
    return np.rint(255 * simulated.burst.frames[..., 0]).astype(np.uint8)


@pytest.fixture
def clip(tmp_path, monkeypatch, frames):
    monkeypatch.chdir(tmp_path)
    return write_clip(tmp_path / "a clip.mkv", "ffv1", "gray", list(frames[[*range(40), 39, *range(40, 70)]]), group=10)


def told_of(words, capsys):
    assert main(["info", *words]) == 0
    lines = [(line[:15].strip(), line[16:]) for line in capsys.readouterr().out.splitlines()]
    return dict(lines)


def test_info_tells_what_a_video_holds_and_offers_a_burst(clip, capsys):
    told = told_of(["a clip.mkv"], capsys)
    assert told["frames"] == "71"
    assert told["height x width"] == "90 x 122"
    assert told["codec"] == "ffv1, gray, 8 key frames"
    assert told["rate"] == "25 frames a second"
    assert told["length"] == "2.84 s"
    assert told["doubled frames"] == "1: 40"
    assert told["levels"] == "black 0, white 255"
    assert told["shows"].startswith("cores 5.0 px apart")
    words = told["a good burst"].split()
    assert told["a good burst"].startswith("fiberburst reconstruct 'a clip.mkv' --frames ")
    first, stop = map(int, words[words.index("--frames") + 1].split(":"))
    assert 0 <= first == stop - 20 <= 51


def test_info_offers_numbers_of_the_whole_recording(clip, capsys):
    offered = told_of(["a clip.mkv", "--frames", "8::1"], capsys)["a good burst"].split("--frames ")[1].split()[0]
    assert int(offered.split(":")[0]) >= 8
    every_second = told_of(["a clip.mkv", "--frames", "1:60:2"], capsys)
    assert every_second["frames"] == "30"
    assert "a good burst" not in every_second


def test_info_tells_a_variable_rate(tmp_path, capsys):
    at = np.cumsum([0, 40, 40, 120, 7, 33, 200, 40]).tolist()
    write_clip(tmp_path / "a.mkv", "ffv1", "gray", [drawn(number) for number in range(8)], at=at)
    told = told_of([str(tmp_path / "a.mkv")], capsys)
    assert told["rate"] == "25 frames a second, variable"
    assert told["times"] == "0 to 0.48 s"


def test_a_rate_whose_times_are_rounded_is_not_variable(tmp_path, capsys):
    write_clip(tmp_path / "a.mkv", "ffv1", "gray", [drawn(number) for number in range(40)], rate=60)
    assert told_of([str(tmp_path / "a.mkv")], capsys)["rate"] == "60 frames a second"


def test_info_of_a_stack_knows_no_rate(tmp_path, capsys):
    tifffile.imwrite(tmp_path / "a.tif", np.stack([drawn(number) for number in range(4)]), photometric="minisblack")
    told = told_of([str(tmp_path / "a.tif")], capsys)
    assert told["times"] == "unknown"
    assert told["doubled frames"] == "none"
    assert not {"rate", "length", "codec", "a good burst"} & set(told)


def test_frames_of_a_video_are_reconstructed(clip, capsys):
    command = ["reconstruct", "a clip.mkv", "-o", "image.tif", "--device", "cpu"]
    assert main([*command, "--frames", "10:16"]) == 0
    assert "Burst(6 frames of 90 x 122" in capsys.readouterr().out
    assert tifffile.imread("image.tif").shape == (90, 122)
    assert main([*command, "--frames", "100:120"]) == 2
    assert "has 71 frames, 0 to 70, and none of them is in 100:120" in capsys.readouterr().err


def test_frames_of_a_video_calibrate_a_bundle(clip, capsys):
    assert main(["calibrate", "a clip.mkv", "--frames", "0:70:10", "-o", "a.bundle", "--device", "cpu"]) == 0
    expected = Bundle.from_burst(read_burst(clip, frames="0:70:10"), device="cpu")
    np.testing.assert_allclose(Bundle.load("a.bundle").centres, expected.centres)
    capsys.readouterr()
    assert main(["calibrate", "a clip.mkv", "--even", "--frames", "0:9", "-o", "b.bundle"]) == 2
    assert "--frames chooses frames of a burst" in capsys.readouterr().err


def test_a_file_that_is_no_video_is_said(tmp_path, capsys):
    (tmp_path / "a.avi").write_text("no video")
    assert main(["info", str(tmp_path / "a.avi")]) == 2
    assert "cannot be read as video" in capsys.readouterr().err


def test_every_frame_of_a_video_is_reconstructed(tmp_path, monkeypatch, capsys, frames):
    monkeypatch.chdir(tmp_path)
    write_clip(tmp_path / "a.mkv", "ffv1", "gray", list(frames[:24]), group=10)
    tifffile.imwrite("regions.tif", np.pad(np.full((20, 30), 7, np.uint8), ((30, 40), (40, 52))))
    command = ["video", "a.mkv", "-o", "a.ome.zarr", "--window", "7", "--mp4", "a.mp4", "--regions", "regions.tif"]
    assert main(command) == 0
    assert "frames placed 24 of 24, each from 7" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.mkv",
        "a.mp4",
        "a.ome.zarr",
        "a.poses.csv",
        "a.traces.csv",
        "a.traces.zarr",
        "regions.tif",
    ]
    assert open_recording("a.ome.zarr").shape == (24, 90, 122, 1)
    assert (tmp_path / "a.traces.csv").read_text().startswith("frame,seconds,region_7\n0,0.0,")
    assert main(command) == 2
    assert "a.ome.zarr is there already" in capsys.readouterr().err
    (tmp_path / "no.tif").write_text("no labels")
    assert main([*command[:3], "b.ome.zarr", "--regions", "no.tif"]) == 2
    assert "no.tif cannot be read as a label image" in capsys.readouterr().err


@pytest.fixture
def short(tmp_path, monkeypatch, frames):
    """Return the command that makes a video and a film of 12 frames."""
    monkeypatch.chdir(tmp_path)
    write_clip(tmp_path / "a.mkv", "ffv1", "gray", list(frames[:12]), group=6)
    return ["video", "a.mkv", "-o", "a.ome.zarr", "--window", "5", "--mp4", "a.mp4"]


def test_a_film_that_is_there_is_replaced_only_where_that_is_asked_for(short, tmp_path, capsys):
    film = tmp_path / "a.mp4"
    film.write_bytes(b"mine")
    assert main(short) == 2
    assert "a.mp4 is there already; choose another name, remove it, or replace it by --ov" in capsys.readouterr().err
    assert film.read_bytes() == b"mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mkv", "a.mp4"]  # no work was begun
    assert main([*short, "--overwrite"]) == 0
    assert len(open_recording(film)) == 12
    assert main([*short[:-1], "a.mkv", "--overwrite"]) == 2
    assert "a.mkv is what the result is made from, and would be lost" in capsys.readouterr().err
    assert len(open_recording("a.mkv")) == 12


def test_a_run_goes_on_with_its_own_film_and_not_with_another(short, tmp_path, monkeypatch, capsys):
    film = tmp_path / "a.mp4"
    with monkeypatch.context() as patched:
        patched.setattr(video, "finish", interrupted)  # after all is written
        with pytest.raises(SystemExit):
            main(short)
    assert len(open_recording(film)) == 12
    (tmp_path / "b.mp4").write_bytes(b"mine")
    assert main([*short[:-1], "b.mp4"]) == 2
    assert "b.mp4 is there already" in capsys.readouterr().err
    assert (tmp_path / "b.mp4").read_bytes() == b"mine"
    assert main(short) == 0
    assert len(open_recording(film)) == 12
    assert not (tmp_path / "a.work").exists()


def interrupted(folder):
    raise KeyboardInterrupt
