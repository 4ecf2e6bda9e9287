"""A model in napari: dropped on the window, it brings back the layers of its run; and it is saved from there."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Image, Layer, Shapes, Tracks, Vectors
from npe2 import PluginManifest

from napari_fiberburst import Burst, load, reconstruct
from napari_fiberburst.errors import OutputError
from napari_fiberburst.plugin import contributions
from napari_fiberburst.plugin.evidence import KINDS, kinds_of
from napari_fiberburst.plugin.layers import RunLayers
from napari_fiberburst.plugin.models import model_layers
from napari_fiberburst.plugin.placement import Placement
from napari_fiberburst.plugin.saving import save_result
from napari_fiberburst.simulation import Faults, simulate

MANIFEST = PluginManifest.from_distribution("napari-fiberburst")


@pytest.fixture(scope="module")
def bent():
    """Return 7 grey frames of 43 x 51 that bend, and what comes of them; some cores are marked as outliers."""
    faults = Faults(deformation=2.0, deformation_length=30.0)
    made = simulate("cat", shape=(43, 51), frames=7, pitch=5.0, physics="core", channels=1, faults=faults)
    frames = made.arrays()["frames"][..., 0]
    burst = Burst(frames, pixel_size=(0.5, 0.25), unit="µm")
    result = reconstruct(burst, device="cpu", motion="deformable", smoothness=0.01)
    outliers = result.outliers.copy()
    outliers[3, ::5] = True
    return frames, replace(result, outliers=outliers)


def opened(result, tmp_path, name="cat"):
    path = str(result.save(tmp_path / f"{name}.fiberburst"))
    tuples = contributions.get_reader(path)(path)
    return {data[1]["name"]: Layer.create(*data) for data in tuples}


def assert_alike(one, other):
    """Assert that two layers show the same in the same place."""
    assert type(one) is type(other)
    for attribute in ("scale", "translate", "affine"):
        np.testing.assert_allclose(getattr(one, attribute), getattr(other, attribute))
    assert one.units == other.units
    assert one.axis_labels == other.axis_labels
    if isinstance(one, Image):
        np.testing.assert_array_equal(np.asarray(one.data), np.asarray(other.data))
        assert one.rgb == other.rgb
        assert one.colormap.name == other.colormap.name
        np.testing.assert_allclose(one.contrast_limits, other.contrast_limits)
    elif isinstance(one, Shapes):
        for first, second in zip(one.data, other.data, strict=True):
            np.testing.assert_allclose(first, second)
        np.testing.assert_array_equal(one.edge_color, other.edge_color)
    else:
        np.testing.assert_allclose(one.data, other.data)


def test_a_model_brings_back_every_layer_of_its_run(viewer, bent, tmp_path):
    frames, result = bent
    layer = Image(frames, scale=(1, 0.5, 0.25), units=("pixel", "µm", "µm"), axis_labels=("t", "y", "x"))
    layers = RunLayers(viewer, "cat", Placement.of([layer], "TYX", (0, 0)), {"run": "cat"})
    layers.finish(result, frames)
    for kind in layers.kinds:
        layers.switch(kind, True)
    there = {layer.name: layer for layer in viewer.layers}
    back = opened(result, tmp_path)
    assert set(there) == {f"cat: {kind}" for kind in ("image", *KINDS)}
    assert set(back) == set(there) - {"cat: stabilised burst"}  # which is made of the burst's pixels
    for name, layer in back.items():
        assert_alike(layer, there[name])
        assert layer.visible == (name == "cat: image")


def test_a_model_that_is_dropped_on_the_window_opens(make_napari_viewer, npe2pm, bent, tmp_path):
    npe2pm.register(MANIFEST)
    _, result = bent
    viewer = make_napari_viewer()
    viewer.open(str(result.save(tmp_path / "cat.fiberburst")), plugin=None)
    kinds = [layer.name.removeprefix("cat: ") for layer in viewer.layers]
    assert kinds[0] == "image"
    assert kinds[-3:] == ["outlines", "path", "displacement"]
    assert {type(layer) for layer in viewer.layers} == {Image, Shapes, Tracks, Vectors}
    for layer in viewer.layers:
        layer.visible = True
        assert layer.source.reader_plugin == "napari-fiberburst"
        assert layer.metadata["fiberburst"]["run"] == "cat"
        assert layer.metadata["fiberburst"]["quality"] == result.quality
    viewer.dims.set_current_step(0, 3)
    np.testing.assert_array_equal(viewer.layers[0].data, result.image)
    (saved,) = viewer.layers[0].save(str(tmp_path / "again.fiberburst"))
    np.testing.assert_array_equal(load(saved, "cpu").coverage, result.coverage)


@pytest.mark.parametrize("channels", [2, 3])
def test_channels_come_back_as_the_burst_is_opened(tmp_path, rng, fit, channels):
    burst = Burst(rng.integers(0, 255, (3, 31, 37, channels), dtype=np.uint8))
    result = fit(burst, upsample=2)
    back = opened(result, tmp_path)
    assert set(back) == {f"cat: {kind}" for kind in ("image", "outlines", "path")}
    image = back["cat: image"]
    assert image.rgb == (channels == 3)
    if channels == 2:
        np.testing.assert_array_equal(image.data, result.image.transpose(2, 0, 1))
    np.testing.assert_allclose(image.scale[-2:], 0.5)


def test_a_cropped_burst_lies_where_it_was_cropped_from(tmp_path, rng, fit):
    frames = rng.integers(0, 255, (3, 43, 51), dtype=np.uint8)
    result = fit(Burst(frames).crop((5, 40), (7, 44)))
    np.testing.assert_allclose(opened(result, tmp_path)["cat: image"].translate, (5, 7))


def test_frames_whose_flow_folds_lie_where_their_homographies_say(tmp_path, rng, fit):
    result = fit(rng.integers(0, 255, (3, 31, 37), dtype=np.uint8), motion="flow", iterations=1)
    plain = opened(result, tmp_path)["cat: path"].data
    folded = replace(result, renderer=_Folded())
    folded_path = model_layers(folded, "cat", contributions._look(result.acquisition))
    (drawn,) = [data for data, look, _ in folded_path if look["name"] == "cat: path"]
    np.testing.assert_allclose(drawn, plain, atol=0.1)  # of a flow that is next to nothing after one step


class _Folded:
    """Draws nothing, and finds no point of any frame again."""

    def displacement(self, points, frame):
        return np.full(points.shape, np.nan)


def test_a_verdict_that_is_not_good_is_told(tmp_path, bent, capsys, monkeypatch):
    told = []
    monkeypatch.setattr("napari.utils.notifications.show_warning", told.append)
    _, result = bent
    opened(replace(result, quality="good"), tmp_path)
    assert told == []
    opened(replace(result, quality="bad", notes=("nothing moves",)), tmp_path)
    assert told == ["cat.fiberburst: the image is bad: nothing moves"]


def test_a_damaged_model_is_refused(tmp_path, bent):
    path = bent[1].save(tmp_path / "cat.fiberburst")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(OutputError, match=r"cat\.fiberburst is no model, or is damaged"):
        contributions.get_reader(str(path))(str(path))


def test_a_layer_of_a_run_is_saved_as_a_model(tmp_path, bent):
    back = opened(bent[1], tmp_path)
    image, coverage = back["cat: image"], back["cat: coverage"]
    path = str(tmp_path / "again.fiberburst")
    assert contributions.write(path, image.data, {"metadata": image.metadata}) == [path]
    np.testing.assert_array_equal(load(path, "cpu").residuals, bent[1].residuals)
    with pytest.raises(OutputError, match="this layer is none"):
        contributions.write(str(tmp_path / "x.fiberburst"), coverage.data, {"metadata": coverage.metadata})


def test_the_dock_saves_a_run_as_a_model(viewer, bent, kept_run, tmp_path):
    frames, result = bent
    layer = Image(frames, name="burst")
    save_result(kept_run(viewer, [layer], "TYX", result), tmp_path / "run.fiberburst")
    np.testing.assert_array_equal(load(tmp_path / "run.fiberburst", "cpu").uncertainty, result.uncertainty)
    assert set(kinds_of(result, Placement.of([layer], "TYX", (0, 0)))) == set(KINDS)
