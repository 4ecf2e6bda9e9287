"""The live view of a replayed recording, on the command line."""

import re
from functools import lru_cache

import numpy as np
import pytest
import tifffile
from PIL import Image

from napari_fiberburst import LiveEngine, open_recording
from napari_fiberburst.cli import main
from napari_fiberburst.live.clocks import SimulatedClock
from napari_fiberburst.live.sources import Replay
from napari_fiberburst.live.watching import watch
from napari_fiberburst.simulation import simulate_recording


@lru_cache
def recorded():
    return simulate_recording(frames=12, shape=(97, 121), pitch=5.0, path="handheld", step=1.5, seed=5)


@pytest.fixture
def clip(tmp_path):
    """Return a recording of twelve frames, and its bundle in even light."""
    path, flat = tmp_path / "clip.tif", tmp_path / "flat.png"
    tifffile.imwrite(path, recorded().source.recorded(range(12))[..., 0], metadata={"axes": "TYX"})

    Image.fromarray(np.rint(np.clip(recorded().transmission * 255, 0, 255)).astype(np.uint8)).save(flat)
    return path, flat


def test_a_replay_is_told_and_filmed(clip, tmp_path, capsys):
    path, flat = clip
    film = tmp_path / "a.mkv"
    assert main(["live", "--replay", str(path), "--fps", "5", "--bundle", str(flat), "-o", str(film)]) == 0
    told = capsys.readouterr().out
    shown, dropped = map(int, re.search(r"pictures (\d+) in .* a second; (\d+) frames dropped", told).groups())
    assert shown + dropped == 12
    assert re.search(r"lag \d+ ms in the median, \d+ ms in the 95th percentile", told)
    assert re.search(r"at last following: (fine|move a little)", told)
    pictures = open_recording(film)
    assert pictures.shape == (12, 97, 121, 1)
    assert np.diff(pictures.acquisition.times) == pytest.approx(0.2, abs=1e-3)
    truth, picture = recorded().truth([11])[0][..., 0], pictures.recorded([11])[0, ..., 0]
    inner = (slice(12, -12), slice(12, -12))
    assert np.corrcoef(picture[inner].ravel(), truth[inner].ravel())[0, 1] > 0.9
    assert {item.name for item in tmp_path.iterdir()} == {"clip.tif", "flat.png", "a.mkv"}


def test_pictures_that_take_no_time_are_not_late(clip):
    source = Replay(open_recording(clip[0]), 30, SimulatedClock())
    watched = list(watch(source, LiveEngine()))
    assert [one.index for one in watched] == list(range(12))
    assert [one.lag for one in watched] == pytest.approx([0] * 12, abs=1e-6)
    assert {one.view.state for one in watched} == {"calibrating"}


def test_what_cannot_be_replayed_is_said(clip, tmp_path, capsys):
    path, flat = clip
    other, there = tmp_path / "other.tif", tmp_path / "there.mp4"
    tifffile.imwrite(other, recorded().source.recorded(range(12))[:, :90, :, 0], metadata={"axes": "TYX"})
    there.write_bytes(b"mine")
    with_bundle = ["--bundle", str(flat), "--fps", "30"]
    for arguments, said in (
        ([path, "--fps", "30"], "has 12 frames, and calibration takes 31 at 30 a second; give --bundle, or a longer"),
        ([path, "--fps", "10"], "has 12 frames, and calibration takes 20 at 10 a second"),
        ([path], "does not tell how many frames it has a second; give a rate"),
        ([path, "--fps", "0"], "a rate above 0 frames a second; got 0"),
        ([other, *with_bundle], "the bundle was measured in frames of 97 x 121 pixels, and the camera gives 90 x 121"),
        ([path, *with_bundle, "-o", there], "is there already; choose another name"),
        ([path, *with_bundle, "-o", tmp_path / "a.gif"], "a video file ends in .avi, .mkv, .mp4"),
        ([tmp_path / "none.avi", "--fps", "30"], "none.avi"),
    ):
        assert main(["live", "--replay", *map(str, arguments)]) == 2
        assert said in capsys.readouterr().err
    assert there.read_bytes() == b"mine"
    assert not list(tmp_path.glob(".*"))
