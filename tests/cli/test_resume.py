"""``fiberburst resume``: a run goes on by the command that it was begun with, from any folder."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import tifffile

from napari_fiberburst import open_recording, reconstruct
from napari_fiberburst.cli import main
from napari_fiberburst.recordings import mosaic as mosaics
from napari_fiberburst.recordings.mosaic import mosaic
from napari_fiberburst.recordings.work import is_begun
from napari_fiberburst.simulation import simulate


@pytest.fixture
def burst(tmp_path):
    path = tmp_path / "b.tif"
    tifffile.imwrite(path, simulate("histology", shape=(45, 52), frames=6, pitch=4.0, channels=1).burst.frames[..., 0])
    return path


def test_a_fit_that_was_killed_goes_on_to_the_same_bits(burst, tmp_path, monkeypatch, capsys):
    words = ["reconstruct", burst.name, "-o", "a.ome.tif", "--encoding", "fourier", "--iterations", "60"]
    kept = tmp_path / "a.checkpoint"
    keeping = ["--checkpoint", kept.name, "--checkpoint-every", "0.01"]
    run = subprocess.Popen([sys.executable, "-m", "napari_fiberburst", *words, *keeping], cwd=tmp_path)
    while not kept.exists() and run.poll() is None:
        time.sleep(0.01)
    run.send_signal(signal.SIGKILL)
    run.wait()
    assert not (tmp_path / "a.ome.tif").exists()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    assert main(["resume", str(kept)]) == 0
    assert "finished after 60 steps" in capsys.readouterr().out
    assert not kept.exists()
    whole = reconstruct(burst, encoding="fourier", iterations=60)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.ome.tif"), whole.image)


@pytest.mark.parametrize("named", ["m.ome.zarr", "m.work"])
def test_a_mosaic_goes_on_though_its_command_would_begin_anew(clip, tmp_path, monkeypatch, stop_drawing, capsys, named):
    monkeypatch.chdir(tmp_path)
    recording = os.path.relpath(clip, tmp_path)
    stop_drawing(["mosaic", recording, "-o", "m.ome.zarr", "--motion", "translation", "--fresh"])
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")

    def traced_again(*given):
        raise AssertionError("what was done is done again")

    monkeypatch.setattr("napari_fiberburst.recordings.traces.trace_part", traced_again)
    assert main(["resume", str(tmp_path / named)]) == 0
    assert f"fiberburst mosaic {recording} -o m.ome.zarr" in capsys.readouterr().out
    assert not is_begun(tmp_path / "m.work")


def test_what_a_script_has_begun_is_told(clip, tmp_path, monkeypatch, capsys):
    def stop(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(mosaics, "draw_unit", stop)
    with pytest.raises(KeyboardInterrupt):
        mosaic(open_recording(clip), tmp_path / "m.ome.zarr", dof=2)
    assert main(["resume", str(tmp_path / "m.ome.zarr")]) == 2
    assert "was begun by a script: run that again" in capsys.readouterr().err


def test_a_command_that_was_altered_is_not_run(clip, tmp_path, stop_drawing, capsys):
    stop_drawing(["mosaic", str(clip), "-o", str(tmp_path / "m.ome.zarr"), "--motion", "translation"])
    for told, why in (
        ('{"words": ["simulate", "-o", "b.tif"], "folder": "/"}', "a command that cannot go on: 'simulate'"),
        ('{"words": "mosaic", "folder": "/"}', "command.json is damaged"),
        ('{"words": ["mosaic"], "folder": "/not/here"}', "which is not there"),
    ):
        (tmp_path / "m.work" / "command.json").write_text(told)
        assert main(["resume", str(tmp_path / "m.ome.zarr")]) == 2
        assert why in capsys.readouterr().err


def test_what_is_no_run_is_told(tmp_path, capsys):
    assert main(["resume", str(tmp_path / "m.ome.zarr")]) == 2
    assert "is no run that was cut short" in capsys.readouterr().err


@pytest.mark.parametrize("task", ["mosaic", "video"])
def test_a_folder_of_others_is_not_taken_for_work(clip, tmp_path, capsys, task):
    """It would be removed when the work is done."""
    (tmp_path / "m.work").mkdir()
    mine = tmp_path / "m.work" / "mine.txt"
    mine.write_text("mine")
    assert main([task, str(clip), "-o", str(tmp_path / "m.ome.zarr")]) == 2
    assert "m.work holds something else, such as mine.txt" in capsys.readouterr().err
    mine.rename(tmp_path / "mine.txt")
    (tmp_path / "m.work").rmdir()
    (tmp_path / "m.work").write_text("no folder")
    assert main([task, str(clip), "-o", str(tmp_path / "m.ome.zarr")]) == 2
    assert "m.work is no folder" in capsys.readouterr().err
