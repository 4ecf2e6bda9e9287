"""A model on the command line: written, told of, and drawn without its burst."""

import json

import numpy as np
import pytest
import tifffile
from PIL import Image

from napari_fiberburst import Burst, load, reconstruct
from napari_fiberburst.cli import main
from napari_fiberburst.simulation import simulate


@pytest.fixture(scope="module")
def result():
    frames = simulate("cat", shape=(43, 51), frames=5, pitch=5.0, physics="core", channels=1).arrays()["frames"]
    return reconstruct(Burst(frames[..., 0], pixel_size=(0.5, 0.25), unit="µm"), device="cpu")


@pytest.fixture
def model(result, tmp_path):
    return result.save(tmp_path / "cat.fiberburst")


def size_of(picture):
    with Image.open(picture) as image:
        return image.size


def test_reconstruct_writes_a_model(tmp_path):
    burst = tmp_path / "cat.burst"
    assert main(["simulate", "-o", str(burst), "--shape", "43x51", "--frames", "4", "--pitch", "5"]) == 0
    small = ["--preset", "paper", "--scene-width", "16", "--motion-width", "16", "--batch", "200", "--iterations", "3"]
    out = tmp_path / "cat.fiberburst"
    assert main(["reconstruct", str(burst), "-o", str(out), *small, "--device", "cpu"]) == 0
    assert load(out, "cpu").image.shape == (43, 51, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cat.burst", "cat.fiberburst"]


def test_a_model_is_drawn_as_a_frame_sees_it(result, model, tmp_path):
    out = tmp_path / "frame.ome.tif"
    assert main(["render", str(model), "--scale", "4", "--frame", "-2", "-o", str(out)]) == 0
    drawn = tifffile.imread(out)
    assert drawn.shape == (172, 204)
    np.testing.assert_allclose(drawn, result.frame(3, 4), rtol=1e-6)
    told = json.loads((tmp_path / "frame.json").read_text())
    assert told["seen_by_frame"] == 3
    assert told["canvas"]["shape"] == [172, 204]
    assert told["settings"]["method"]["smoothness"] == result.settings.method.smoothness


def test_a_part_of_a_model_is_drawn_with_its_pixel_size(result, model, tmp_path):
    out = tmp_path / "part.ome.tif"
    bounds = (-3.5, 4, 47, 39)
    assert main(["render", str(model), "--scale", "2", "--bounds", *map(str, bounds), "-o", str(out)]) == 0
    with tifffile.TiffFile(out) as file:
        np.testing.assert_allclose(file.asarray(), result.render(2, bounds), rtol=1e-6)
        pixels = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]["Pixels"]
    assert (pixels["PhysicalSizeY"], pixels["PhysicalSizeX"]) == (0.25, 0.125)
    assert json.loads((tmp_path / "part.json").read_text())["seen_by_frame"] == result.reference


def test_a_model_is_drawn_as_a_picture(model, tmp_path):
    assert main(["render", str(model), "-o", str(tmp_path / "look.png")]) == 0
    assert size_of(tmp_path / "look.png") == (51, 43)


def test_a_file_of_networks_is_drawn_too(fit, tiny_burst, tmp_path):
    networks = fit(tiny_burst).save(tmp_path / "scene.npz")
    assert main(["render", str(networks), "--scale", "2", "-o", str(tmp_path / "look.png")]) == 0
    assert size_of(tmp_path / "look.png") == (74, 62)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--frame", "5", "-o", "a.png"], "has frames 0 to 4; there is no frame 5"),
        (["--scale", "-1", "-o", "a.png"], "scale must be a number above 0"),
        (["--bounds", "5", "5", "5", "9", "-o", "a.png"], "x0 < x1"),
        (["-o", "cat.fiberburst"], "an image is drawn into a file ending in .ome.tif"),
        (["-o", "a.npz"], "an image is drawn into a file ending in .ome.tif"),
        (["-o", "nowhere/a.png"], "does not exist"),
    ],
)
def test_what_cannot_be_drawn_is_refused(model, tmp_path, monkeypatch, capsys, options, said):
    before = model.read_bytes()
    monkeypatch.chdir(tmp_path)
    assert main(["render", str(model), *options]) == 2
    assert said in capsys.readouterr().err
    assert model.read_bytes() == before


def test_a_frame_and_a_part_cannot_be_drawn_at_once(model, tmp_path):
    with pytest.raises(SystemExit):
        main(["render", str(model), "--frame", "1", "--bounds", "0", "0", "9", "9", "-o", str(tmp_path / "a.png")])


def test_info_says_what_a_model_is(result, model, capsys):
    assert main(["info", str(model)]) == 0
    told = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert told["frames"] == "5, of which 5 take part"
    assert told["height"] == "x width  43 x 51"
    assert told["verdict"] == result.quality
    assert told["compression"].startswith(f"{1 - 4 * result.parameters / (5 * 43 * 51):.1%}: {result.parameters} ")
    assert f"napari-fiberburst {result.made_with['versions']['napari-fiberburst']}" in told["made"]


def test_a_damaged_model_is_refused(model, tmp_path, capsys):
    model.write_bytes(model.read_bytes()[:-7])
    for command in (["info", str(model)], ["render", str(model), "-o", str(tmp_path / "a.png")]):
        assert main(command) == 2
        assert "is no model, or is damaged" in capsys.readouterr().err
