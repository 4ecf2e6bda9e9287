"""``fiberburst mosaic``: what is there is resumed, begun anew or replaced as asked."""

import signal

import numpy as np
import pytest

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.cli import main
from napari_fiberburst.recordings import mosaic as mosaics
from napari_fiberburst.recordings.work import is_begun


@pytest.fixture
def words(clip, tmp_path):
    return ["mosaic", str(clip), "-o", str(tmp_path / "m.ome.zarr"), "--motion", "translation"]


def test_an_output_is_replaced_only_where_that_is_asked_for(words, tmp_path, capsys):
    assert main(words) == 0
    told = capsys.readouterr().out
    assert "frames placed 12 of 12, in one piece" in told
    assert "m.poses.csv" in told
    (tmp_path / "m.ome.zarr" / "old").touch()
    assert main(words) == 2
    assert "m.ome.zarr is there already; choose another name, remove it, or replace it" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    assert not (tmp_path / "m.ome.zarr" / "old").exists()
    assert not is_begun(tmp_path / "m.work")


def test_a_recording_keeps_its_bundle_and_improves_one(words, tmp_path, capsys):
    first, second = tmp_path / "first.bundle", tmp_path / "second.bundle"
    assert main([*words, "--keep-bundle", str(first)]) == 0
    assert f"wrote {first}" in capsys.readouterr().out
    found = Bundle.load(first)
    assert found.gains_known
    assert main([*words, "--overwrite", "--bundle", str(first), "--keep-bundle", str(second)]) == 0
    better = Bundle.load(second)
    assert better.provenance["bursts"] == found.provenance.get("bursts", 0) + 1
    assert (better.gain_weights >= found.gain_weights).all()
    assert (better.gain_weights > found.gain_weights).mean() > 0.9


def test_a_bundle_that_cannot_be_kept_is_told_before_anything_is_done(words, tmp_path, capsys):
    assert main([*words, "--keep-bundle", str(tmp_path / "probe.npz")]) == 2
    assert "ending in .bundle" in capsys.readouterr().err
    assert not (tmp_path / "m.work").exists()


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_stopped_goes_on(words, tmp_path, capsys, monkeypatch, number, status):
    def stop(*given):
        signal.raise_signal(number)

    with monkeypatch.context() as patched:
        patched.setattr(mosaics, "draw_unit", stop)
        with pytest.raises(SystemExit) as stopped:
            main(words)
    assert stopped.value.code == status
    assert "what is done stays, and the same command goes on" in capsys.readouterr().err
    assert main([*words[:-1], "similarity"]) == 2
    assert "(dof was 2, is 4)" in capsys.readouterr().err

    def traced_again(*given):
        raise AssertionError("what was done is done again")

    monkeypatch.setattr("napari_fiberburst.recordings.traces.trace_part", traced_again)
    assert main(words) == 0


def test_work_is_begun_anew_where_that_is_asked_for(words, tmp_path, stop_drawing):
    stop_drawing(words)
    assert (tmp_path / "m.ome.zarr").exists()
    assert main([*words[:-1], "similarity", "--fresh"]) == 0
    poses = np.genfromtxt(tmp_path / "m.poses.csv", delimiter=",", names=True)
    assert len(poses) == 12


def test_what_is_no_picture_is_not_replaced(words, tmp_path, clip, capsys):
    (tmp_path / "m.ome.zarr").mkdir()
    (tmp_path / "m.ome.zarr" / "mine").touch()
    assert main([*words, "--overwrite"]) == 2
    assert "is no OME-Zarr, and would be lost" in capsys.readouterr().err
    assert (tmp_path / "m.ome.zarr" / "mine").exists()
    assert main(["mosaic", str(clip), "-o", str(clip), "--overwrite"]) == 2
    assert "is what the result is made from" in capsys.readouterr().err
    assert clip.exists()
