"""Results out: what is in the files, and that a file is whole or not there."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import tifffile

from napari_fiberburst import Burst, load, read_burst
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.results import check_output, sidecar_of, write_whole


def test_an_image_with_its_provenance_beside_it(fit, tiny_burst, tmp_path):
    result = fit(tiny_burst)
    assert result.save(tmp_path / "image.ome.tif") == tmp_path / "image.ome.tif"
    with tifffile.TiffFile(tmp_path / "image.ome.tif") as file:
        assert file.is_ome
        assert file.series[0].axes == "CYX"
        np.testing.assert_array_equal(np.moveaxis(file.asarray(), 0, 2), result.image)
    told = json.loads((tmp_path / "image.json").read_text())
    assert told["settings"] == result.settings.to_dict()
    assert told["homographies"] == result.homographies.tolist()
    assert told["losses"] == [float(loss) for loss in result.losses]
    assert told["seed"] == 0
    assert set(told["versions"]) >= {"python", "numpy", "torch", "napari-fiberburst"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["image.json", "image.ome.tif"]


def test_pixel_size_and_channel_names_go_along(fit, rng, tmp_path):
    burst = Burst(rng.random((3, 17, 23, 2)), pixel_size=(0.75, 0.5), unit="nm", channel_names=["a", "b"])
    fit(burst).save(tmp_path / "image.ome.tif")
    with tifffile.TiffFile(tmp_path / "image.ome.tif") as file:
        pixels = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]["Pixels"]
    assert (pixels["PhysicalSizeY"], pixels["PhysicalSizeX"]) == (0.75, 0.5)
    assert pixels["PhysicalSizeXUnit"] == "nm"
    assert [channel["Name"] for channel in pixels["Channel"]] == ["a", "b"]


def test_a_grey_image_is_a_plane(fit, rng, tmp_path):
    fit(rng.random((3, 17, 23))).save(tmp_path / "image.tif")
    assert tifffile.imread(tmp_path / "image.tif").shape == (17, 23)
    assert (tmp_path / "image.json").exists()


@pytest.mark.parametrize(
    ("name", "beside"), [("a.ome.tif", "a.json"), ("a.b.TIF", "a.b.json"), ("a.ome.tiff", "a.json")]
)
def test_the_sidecar_has_the_images_name(tmp_path, name, beside):
    assert sidecar_of(tmp_path / name) == tmp_path / beside


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("missing/image.tif", "does not exist; make it first"),
        ("image.jpg", "ending in .ome.tif"),
        ("image", "ending in .ome.tif"),
        ("folder.tif", "is a folder"),
    ],
)
def test_places_that_cannot_be_written_are_refused(fit, tiny_burst, tmp_path, place, said):
    (tmp_path / "folder.tif").mkdir()
    with pytest.raises(OutputError, match=said):
        check_output(tmp_path / place)
    with pytest.raises(OutputError, match=said):
        fit(tiny_burst).save(tmp_path / place)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.tif"]


@pytest.mark.parametrize("name", ["scene.npz", "SCENE.NPZ", ".npz"])
def test_networks_go_into_npz_however_it_is_written(fit, tiny_burst, tmp_path, name):
    result = fit(tiny_burst)
    np.testing.assert_array_equal(load(result.save(tmp_path / name), device="cpu").image, result.image)


def test_what_is_not_ours_is_not_replaced(fit, tiny_burst, tmp_path):
    (tmp_path / "raw.json").write_text('{"exposure": 3}')
    (tmp_path / "list.json").write_text("[1]")
    (tmp_path / "folder.json").mkdir()
    result = fit(tiny_burst)
    for name, said in (("raw.tif", "not of napari-fiberburst"), ("list.tif", "not of"), ("folder.tif", "is a folder")):
        with pytest.raises(OutputError, match=said):
            result.save(tmp_path / name)
    assert (tmp_path / "raw.json").read_text() == '{"exposure": 3}'
    result.save(tmp_path / "new.tif")
    result.save(tmp_path / "new.tif")  # a result of ours gives way to another
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "folder.json",
        "list.json",
        "new.json",
        "new.tif",
        "raw.json",
    ]


def test_the_source_of_a_result_is_not_replaced(tmp_path):
    (tmp_path / "burst.tif").write_bytes(b"frames")
    with pytest.raises(OutputError, match="would be lost"):
        check_output(tmp_path / "burst.tif", source=tmp_path / "burst.tif")


@pytest.mark.parametrize("source", ["frames", "frames/*.png"])
def test_a_result_does_not_become_a_frame_of_its_burst(tmp_path, source):
    (tmp_path / "frames").mkdir()
    with pytest.raises(OutputError, match="would be read as a frame"):
        check_output(tmp_path / "frames" / "image.png", source=tmp_path / source)
    check_output(tmp_path / "image.png", source=tmp_path / source)


def test_an_image_and_its_provenance_appear_together_or_not_at_all(fit, tiny_burst, tmp_path, monkeypatch):
    result = fit(tiny_burst)
    synced = []

    def fail_at_the_second(number):
        synced.append(number)
        if len(synced) == 2:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail_at_the_second)
    with pytest.raises(OutputError, match="No space left"):
        result.save(tmp_path / "image.tif")
    names = {path.name for path in tmp_path.iterdir()}
    assert "image.tif" not in names
    assert not any(name.endswith(".part") for name in names)


def test_a_unit_that_ome_does_not_know_stands_in_the_json_alone(fit, rng, tmp_path):
    burst = Burst(rng.random((3, 17, 23)), pixel_size=2, unit="furlong")
    fit(burst).save(tmp_path / "image.tif")
    with tifffile.TiffFile(tmp_path / "image.tif") as file:
        assert "PhysicalSize" not in file.ome_metadata
    assert json.loads((tmp_path / "image.json").read_text())["burst"]["unit"] == "furlong"


def test_a_folder_without_permission_is_refused(tmp_path, monkeypatch):
    # The superuser may write anywhere, so the answer of the system is stood in for.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(OutputError, match="cannot be written; choose another"):
        check_output(tmp_path / "image.tif")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "file.bin"
    path.write_bytes(b"old")

    def write_half():
        with write_whole(path) as stream:
            stream.write(b"ne")
            raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        write_half()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_an_output_error(tmp_path):
    def write():
        with write_whole(tmp_path / "file.bin"):
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="No space left"):
        write()


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_a_killed_run_leaves_no_half_file(tmp_path):
    path = tmp_path / "file.bin"
    code = (
        "import sys, time; from pathlib import Path; from napari_fiberburst.io.results import write_whole\n"
        "with write_whole(Path(sys.argv[1])) as stream:\n"
        "    stream.write(b'half'); stream.flush(); print('half', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE)
    with process:
        assert process.stdout.readline() == b"half\n"
        process.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 10
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not path.exists()


def test_a_saved_image_is_a_burst_of_one_frame(fit, rng, tmp_path):
    fit(rng.random((3, 17, 23))).save(tmp_path / "image.tif")
    assert read_burst(tmp_path / "image.tif").shape == (1, 17, 23, 1)
