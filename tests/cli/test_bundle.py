"""Bundles on the command line: measured, kept, used, improved, drawn."""

import numpy as np
import pytest
import tifffile
from imageio.v3 import imread

from napari_fiberburst import Bundle, Control
from napari_fiberburst.cli import main
from napari_fiberburst.simulation import simulate


@pytest.fixture(scope="module")
def simulated():
    probe = {"shape": (91, 103), "pitch": 6.0, "physics": "core", "dead_cores": 0.02}
    return simulate("histology", frames=5, channels=1, seed=1, **probe)


@pytest.fixture
def files(simulated, tmp_path, monkeypatch):
    """Lay a burst, one frame of it, an even flat and a dark image into the working folder."""
    monkeypatch.chdir(tmp_path)
    frames = np.rint(simulated.burst.frames[..., 0] * 255).astype(np.uint8)
    flat = np.rint(200 * simulated.transmission).astype(np.uint8)
    tifffile.imwrite("burst.tif", frames, photometric="minisblack")
    tifffile.imwrite("frame.tif", frames[0])
    tifffile.imwrite("flat.tif", flat + 9)
    tifffile.imwrite("flats.tif", np.stack([flat, flat]), photometric="minisblack")
    tifffile.imwrite("dark.tif", np.full_like(flat, 9) + (np.indices(flat.shape).sum(axis=0) % 2).astype(np.uint8))
    return tmp_path


def test_calibrate_says_what_it_has_found(files, capsys, simulated):
    assert main(["calibrate", "flat.tif", "-o", "probe.bundle", "--device", "cpu"]) == 0
    told = dict(line.split(None, 1) for line in capsys.readouterr().out.splitlines())
    bundle = Bundle.load("probe.bundle")
    assert int(told["cores"]) == len(bundle.centres)
    assert float(told["pitch"].split()[0]) == pytest.approx(6, rel=0.02)
    assert float(told["footprint"].split()[0]) == pytest.approx(0.38 * 6, rel=0.06)
    assert int(told["dead"]) == len(bundle.dead) > 0
    assert told["saturated"] == "0"
    assert float(told["black"]) == pytest.approx(9, abs=1)
    assert "image, flat.tif" in told["from"]
    assert told["wrote"] == "probe.bundle"


@pytest.mark.parametrize(
    ("given", "source", "frames"),
    [
        (["flat.tif"], "image", 1),
        (["burst.tif"], "burst", 5),
        (["flats.tif", "--even"], "image", 2),
        (["flat.tif", "flat.tif", "--even"], "image", 2),
        (["flat.tif", "--dark", "dark.tif"], "image", 1),
    ],
    ids=str,
)
def test_calibrate_takes_images_in_even_light_or_a_burst(files, given, source, frames):
    assert main(["calibrate", *given, "-o", "probe.bundle", "--device", "cpu"]) == 0
    told = Bundle.load("probe.bundle").provenance
    assert (told["source"], told["frames"]) == (source, frames)
    assert told["files"][0] == given[0]
    assert ("dark" in told) == ("--dark" in given)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["calibrate", "flat.tif", "flat.tif", "-o", "a.bundle"], "add --even"),
        (["calibrate", "burst.tif", "--dark", "dark.tif", "-o", "a.bundle"], "add --even, or leave --dark out"),
        (["calibrate", "none.tif", "-o", "a.bundle"], "there is no none.tif"),
        (["calibrate", "none.png", "-o", "a.bundle"], "there is no none.png"),
        (["calibrate", "flat.tif", "-o", "a.npz"], "ending in .bundle"),
        (["calibrate", "flat.tif", "-o", "nowhere/a.bundle"], "the folder nowhere does not exist"),
        (["calibrate", "dark.tif", "-o", "a.bundle"], "shows no bundle"),
        (["calibrate", "dark.tif", "--dark", "flat.tif", "-o", "a.bundle"], "flat.tif is brighter than dark.tif"),
        (["info", "flat.tif", "-o", "a.png"], "only a bundle is drawn"),
        (["info", "none.bundle"], "there is no file none.bundle"),
        (["info", "none.bundle", "-o", "a.gif"], "drawn as a .png"),
        (["reconstruct", "frame.tif", "-o", "a.tif"], "give a bundle"),
        (["reconstruct", "frame.tif", "-o", "a.tif", "--bundle", "none.bundle"], "there is no file none.bundle"),
        (["reconstruct", "frame.tif", "-o", "a.tif", "--bundle", "flat.tif", "--calibration", "flat.tif"], "one of"),
        (["reconstruct", "frame.tif", "-o", "a.tif", "--bundle", "flat.tif", "--preset", "paper"], "leave the bundle"),
        (["reconstruct", "burst.tif", "-o", "a.tif", "--keep-bundle", "a.npz"], "ending in .bundle"),
        (["reconstruct", "burst.tif", "-o", "a.tif", "--keep-bundle", "a.bundle", "--preset", "paper"], "leave the"),
    ],
    ids=str,
)
def test_what_cannot_be_done_is_refused_and_leaves_no_file(files, capsys, command, said):
    before = sorted(files.iterdir())
    assert main(command) == 2
    assert said in capsys.readouterr().err
    assert sorted(files.iterdir()) == before


def test_a_bundle_file_that_is_damaged_is_refused(files, capsys):
    main(["calibrate", "flat.tif", "-o", "probe.bundle", "--device", "cpu"])
    whole = (files / "probe.bundle").read_bytes()
    (files / "probe.bundle").write_bytes(whole[: len(whole) // 2])
    for command in (["info", "probe.bundle"], ["reconstruct", "frame.tif", "-o", "a.tif", "--bundle", "probe.bundle"]):
        assert main(command) == 2
        assert "probe.bundle is no bundle, or is damaged" in capsys.readouterr().err


def test_info_tells_and_draws_a_bundle(files, capsys):
    main(["calibrate", "flat.tif", "-o", "probe.bundle", "--device", "cpu"])
    told = capsys.readouterr().out.splitlines()[:-1]
    assert main(["info", "probe.bundle", "-o", "probe.png"]) == 0
    assert capsys.readouterr().out.splitlines() == [*told, "wrote probe.png"]
    np.testing.assert_array_equal(imread("probe.png"), Bundle.load("probe.bundle").to_image())


@pytest.mark.parametrize("given", ["--bundle probe.bundle", "--bundle flat.tif", "--calibration flat.tif"])
def test_one_frame_is_reconstructed_with_a_bundle(files, given, capsys, simulated):
    main(["calibrate", "flat.tif", "-o", "probe.bundle", "--device", "cpu"])
    assert main(["reconstruct", "frame.tif", "-o", "clean.ome.tif", *given.split(), "--device", "cpu"]) == 0
    image, truth = tifffile.imread("clean.ome.tif"), simulated.truth[0, ..., 0]
    seen = np.isfinite(image)
    raw = tifffile.imread("frame.tif")
    clean, dirty = (np.corrcoef(values[seen], truth[seen])[0, 1] for values in (image, raw))
    assert clean > 0.9
    assert clean > dirty + 0.3
    assert "finished after" in capsys.readouterr().out


def test_a_run_keeps_its_bundle_and_improves_one(files, capsys):
    run = ["reconstruct", "burst.tif", "-o", "clean.tif", "--device", "cpu"]
    assert main([*run, "--keep-bundle", "first.bundle"]) == 0
    assert "wrote first.bundle" in capsys.readouterr().out
    first = Bundle.load("first.bundle")
    assert first.gains_known
    assert main([*run, "--bundle", "first.bundle", "--keep-bundle", "second.bundle"]) == 0
    second = Bundle.load("second.bundle")
    assert second.provenance["bursts"] == first.provenance["bursts"] + 1
    assert (second.gain_weights >= first.gain_weights).all()


def test_a_run_that_was_stopped_keeps_no_bundle(files, capsys, monkeypatch):
    monkeypatch.setattr(Control, "stopped", property(lambda control: True))
    run = ["reconstruct", "burst.tif", "-o", "clean.tif", "--device", "cpu", "--keep-bundle", "first.bundle"]
    assert main(run) == 130
    assert "first.bundle was not written" in capsys.readouterr().err
    assert not (files / "first.bundle").exists()
