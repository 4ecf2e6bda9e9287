"""A bundle in the dock: picked, opened, kept, and used for one single frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from napari.layers import Image, Points
from napari.utils.notifications import notification_manager
from npe2 import PluginManifest

import napari_fiberburst
from napari_fiberburst import Bundle
from napari_fiberburst.errors import BundleError
from napari_fiberburst.plugin import contributions
from napari_fiberburst.plugin.saving import keep_bundle

MILLISECONDS = 60_000
ROOT = Path(napari_fiberburst.__file__).parent


@pytest.fixture(scope="module")
def bundle(simulated) -> Bundle:
    """Return the bundle of the burst, 63 x 75 pixels, from an image of it in even light."""
    return Bundle.from_image(np.rint(200 * simulated.transmission).astype(np.uint8))


@pytest.fixture
def bundle_file(bundle, tmp_path):
    return bundle.save(tmp_path / "probe.bundle")


@pytest.fixture
def frame_layer(simulated) -> Image:
    """Return one frame of the burst as an image without time."""
    return Image(simulated.arrays()["frames"][2], rgb=True, name="frame")


def notices_during(act):
    """Return the notifications that came while something was done."""
    before = len(notification_manager.records)
    act()
    return [record.message for record in list(notification_manager.records)[before:]]


def test_a_bundle_opens_as_its_transmission_and_its_cores(bundle, tmp_path):
    saturated = np.zeros(len(bundle.centres), bool)
    saturated[3] = True
    dead = np.array([[20.0, 30.0], [41.0, 17.0]])
    path = replace(bundle, saturated=saturated, dead=dead).save(tmp_path / "Probe 1.bundle")
    (image, look, kind), (points, cores, points_kind) = contributions.get_reader(str(path))(str(path))
    assert (kind, points_kind) == ("image", "points")
    assert (look["name"], cores["name"]) == ("Probe 1", "Probe 1 cores")
    np.testing.assert_array_equal(image, bundle.transmission)
    layer = Points(points, **cores)
    np.testing.assert_allclose(layer.data, np.concatenate([bundle.centres, dead])[:, ::-1])
    np.testing.assert_allclose(layer.size, 2 * bundle.radius)
    states = np.array(["core"] * len(bundle.centres) + ["dead"] * 2, dtype=object)
    states[3] = "saturated"
    assert layer.features["state"].tolist() == states.tolist()
    colours = {state: layer.border_color[states == state] for state in ("core", "saturated", "dead")}
    assert all((colour == colour[0]).all() for colour in colours.values())
    assert len({tuple(colour[0]) for colour in colours.values()}) == 3


def test_napari_opens_a_bundle_by_the_manifest(make_napari_viewer, npe2pm, bundle, bundle_file):
    npe2pm.register(PluginManifest.from_file(ROOT / "napari.yaml"))
    viewer = make_napari_viewer()
    viewer.open(str(bundle_file), plugin="napari-fiberburst")
    assert [layer.name for layer in viewer.layers] == ["probe", "probe cores"]
    opened = viewer.layers["probe"].metadata["fiberburst"]["bundle"]
    np.testing.assert_array_equal(opened.gains, bundle.gains)
    bundle_file.write_bytes(bundle_file.read_bytes()[:500])
    with pytest.raises(BundleError, match="is no bundle, or is damaged"):
        viewer.open(str(bundle_file), plugin="napari-fiberburst")


def test_a_bundle_that_is_kept_and_opened_again_serves_one_frame(
    open_dock, run_through, burst_layer, frame_layer, tmp_path
):
    path = tmp_path / "probe.bundle"
    viewer, dock = open_dock(burst_layer)
    first = run_through(dock)
    keep_bundle(first, path)
    dock.input.open_bundle(path)
    assert dock.input.bundle.value is viewer.layers["probe"]
    viewer.add_layer(frame_layer)
    dock.input.burst.value = frame_layer
    assert dock.input.axes.text() == "YXC"
    second = run_through(dock)
    assert second.result.image.shape == (63, 75, 3)
    np.testing.assert_allclose(second.result.bundle.centres, first.result.bundle.centres, atol=0.1)
    switches = dock.picture.display.card.switches
    offered = [kind for kind, box in switches.items() if not box.isHidden()]
    assert offered == ["coverage", "frames", "uncertainty", "transmission", "residuals"]
    switches["residuals"].setChecked(True)
    assert viewer.layers["run 2: residuals"].data.shape == (63, 75)
    assert f"bundle={str(path)!r}" in second.python


def test_one_frame_resolves_as_in_a_script(open_dock, run_through, frame_layer, bundle, bundle_file):
    from napari_fiberburst import reconstruct

    _, dock = open_dock(frame_layer)
    dock.input.open_bundle(bundle_file)
    run = run_through(dock)
    headless = reconstruct(frame_layer.data[None], bundle=bundle)
    np.testing.assert_allclose(run.result.image, headless.image, rtol=1e-4)


def test_one_frame_without_a_bundle_says_what_to_do(open_dock, frame_layer):
    _, dock = open_dock(frame_layer)
    (notice,) = notices_during(dock.picture.start)
    assert "choose or open its bundle" in notice
    assert dock.picture.runner.state == "ready"


def test_a_bundle_that_was_given_is_kept_improved(open_dock, run_through, burst_layer, bundle, bundle_file, tmp_path):
    _, dock = open_dock(burst_layer)
    dock.input.open_bundle(bundle_file)
    run = run_through(dock)
    keep_bundle(run, tmp_path / "better.bundle")
    better = Bundle.load(tmp_path / "better.bundle")
    np.testing.assert_array_equal(better.centres, bundle.centres)
    assert better.provenance["bursts"] == bundle.provenance["bursts"] + 1
    assert (better.gain_weights >= bundle.gain_weights).all()
    assert (better.gain_weights > bundle.gain_weights).any()


def test_an_image_in_even_light_is_kept_as_a_bundle_improved(open_dock, run_through, burst_layer, simulated, tmp_path):
    even = Image(np.rint(200 * simulated.transmission).astype(np.uint8), name="even")
    _, dock = open_dock(burst_layer, even)
    dock.input.burst.value, dock.input.bundle.value = burst_layer, even
    run = run_through(dock)
    keep_bundle(run, tmp_path / "even.bundle")
    kept = Bundle.load(tmp_path / "even.bundle")
    assert (kept.provenance["source"], kept.provenance["bursts"]) == ("image", 1)
    assert "calibration=viewer.layers['even'].data" in run.python


def test_only_a_run_with_a_resolved_bundle_offers_to_keep_it(open_dock, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    assert not dock.picture.runs.save.bundle.isEnabled()
    run_through(dock)
    assert dock.picture.runs.save.bundle.isEnabled()
    dock.picture.form.set_choices(
        {"preset": "paper", "iterations": 2, "scene_width": 16, "scene_layers": 1, "features": 16}
    )
    published = run_through(dock)
    assert not dock.picture.runs.save.bundle.isEnabled()
    with pytest.raises(BundleError, match="has found no bundle"):
        published.bundle_to_keep()


def test_a_bundle_written_under_another_ending_is_refused_in_words(open_dock, run_through, burst_layer, tmp_path):
    _, dock = open_dock(burst_layer)
    run = run_through(dock)
    (notice,) = notices_during(lambda: keep_bundle(run, tmp_path / "probe.tif"))
    assert "ending in .bundle" in notice
    assert list(tmp_path.glob("probe*")) == []


@pytest.mark.parametrize("damage", ["truncated", "another file"])
def test_a_file_that_is_no_bundle_leaves_the_dock_usable(open_dock, run_through, burst_layer, bundle_file, damage):
    whole = bundle_file.read_bytes()
    bundle_file.write_bytes(whole[: len(whole) // 2] if damage == "truncated" else b"II*\0 not a bundle at all")
    viewer, dock = open_dock(burst_layer)
    (notice,) = notices_during(lambda: dock.input.open_bundle(bundle_file))
    assert str(bundle_file) in notice
    assert "is no bundle, or is damaged" in notice
    assert [layer.name for layer in viewer.layers] == ["burst"]
    assert dock.input.bundle.value is None
    with pytest.raises(BundleError, match="is damaged"):
        contributions.get_reader(str(bundle_file))(str(bundle_file))
    assert run_through(dock).result.ending == "finished"


def test_a_bundle_that_does_not_fit_leaves_the_dock_usable(open_dock, qtbot, burst_layer, bundle, tmp_path):
    path = bundle.crop((0, 50), (0, 61)).save(tmp_path / "small.bundle")
    viewer, dock = open_dock(burst_layer)
    dock.input.open_bundle(path)
    before = len(notification_manager.records)
    with qtbot.waitSignal(dock.picture.runner.ready, timeout=MILLISECONDS):
        dock.picture.start()
    (notice,) = [record.message for record in list(notification_manager.records)[before:]]
    assert "measured in frames of 50 x 61 pixels, and the burst has 63 x 75" in notice
    assert dock.picture.start_button.isEnabled()
    assert not dock.picture.runs.runs
    assert [layer.name for layer in viewer.layers] == ["burst", "small", "small cores"]


def test_a_bundle_is_offered_as_a_bundle_and_as_no_burst(open_dock, burst_layer, bundle_file):
    viewer, dock = open_dock(burst_layer)
    dock.input.open_bundle(bundle_file)
    assert dock.input.burst.choices == (burst_layer,)
    assert viewer.layers["probe"] in dock.input.bundle.choices
    assert viewer.layers["probe cores"] not in dock.input.bundle.choices


def test_a_bundle_lies_over_the_frames_that_it_fits(open_dock, grey_frames, bundle_file):
    layer = Image(grey_frames, scale=(1, 0.5, 0.25), translate=(0, 10, 20), units=("s", "um", "um"))
    viewer, dock = open_dock(layer)
    dock.input.open_bundle(bundle_file)
    for name in ("probe", "probe cores"):
        np.testing.assert_array_equal(viewer.layers[name].scale, [0.5, 0.25])
        np.testing.assert_array_equal(viewer.layers[name].translate, [10, 20])
        assert [str(unit) for unit in viewer.layers[name].units] == ["micrometer", "micrometer"]


def test_the_open_button_asks_for_a_file(open_dock, monkeypatch, burst_layer, bundle_file):
    from qtpy.QtWidgets import QFileDialog

    viewer, dock = open_dock(burst_layer)
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: ("", ""))
    dock.input.open_button.click()
    assert [layer.name for layer in viewer.layers] == ["burst"]
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (str(bundle_file), ""))
    dock.input.open_button.click()
    assert dock.input.bundle.value is viewer.layers["probe"]


def test_the_keep_button_asks_where_to(open_dock, run_through, monkeypatch, burst_layer, tmp_path):
    from qtpy.QtWidgets import QFileDialog

    suggested = []

    def ask(parent, title, name, kinds):
        suggested.append(name)
        return str(tmp_path / "kept.bundle"), kinds

    _, dock = open_dock(burst_layer)
    run = run_through(dock)
    monkeypatch.setattr(QFileDialog, "getSaveFileName", ask)
    dock.picture.runs.save.bundle.click()
    assert suggested == ["burst.bundle"]
    np.testing.assert_array_equal(Bundle.load(tmp_path / "kept.bundle").centres, run.result.bundle.centres)


def test_copied_calls_name_the_bundles_file(open_dock, frame_layer, bundle_file):
    from qtpy.QtWidgets import QApplication

    viewer, dock = open_dock(frame_layer)
    dock.input.open_bundle(bundle_file)
    dock.picture.copying.command.click()
    assert QApplication.clipboard().text().splitlines()[-1] == (
        f"fiberburst reconstruct burst.tif -o image.ome.tif --bundle {bundle_file}"
    )
    dock.picture.copying.python.click()
    scope = {"viewer": viewer}
    exec(QApplication.clipboard().text().replace('result.save("image.ome.tif")\n', ""), scope)
    assert scope["result"].image.shape == (63, 75, 3)
