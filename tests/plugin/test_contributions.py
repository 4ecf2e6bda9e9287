"""What napari finds in the manifest really works."""

import json
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
import tifffile
from npe2 import PluginManifest

from napari_fiberburst.plugin import contributions
from napari_fiberburst.plugin.preferences import Preferences, preferences
from napari_fiberburst.plugin.saving import save_homographies, save_result
from napari_fiberburst.simulation import SCENES, Faults, simulate

MANIFEST = PluginManifest.from_distribution("napari-fiberburst")


def test_every_command_can_be_loaded():
    for command in MANIFEST.contributions.commands:
        module, name = command.python_name.split(":")
        assert callable(getattr(__import__(module, fromlist=[name]), name))


FAULTY = {
    "tissue_bending": {"displacement"},
    "histology_faint": {"exposures"},
    "retina_round": {"visible", "shading"},
}


def test_every_scene_is_a_sample_in_both_physics_and_some_have_faults():
    keys = {sample.key for sample in MANIFEST.contributions.sample_data}
    assert keys == {f"{scene}_{physics}" for scene in SCENES for physics in ("mask", "core")} | set(FAULTY) | {
        "recording_slide"
    }


def test_opening_a_menu_loads_no_torch():
    code = "import napari_fiberburst.plugin.contributions, sys; print('torch' in sys.modules, 'napari' in sys.modules)"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.split() == ["False", "False"]


@pytest.mark.parametrize("key", ["retina_core", "usaf_mask"])
def test_a_sample_carries_its_truth(key):
    ((frames, look, kind),) = getattr(contributions, key)()
    metadata = look["metadata"]["fiberburst"]
    assert kind == "image"
    assert frames.shape[:3] == metadata["truth"].shape[:3] == (20, 256, 256)
    assert frames.dtype == np.uint8
    assert look["rgb"] == (frames.ndim == 4)
    assert metadata["homographies"].shape == (20, 3, 3)


@pytest.mark.parametrize("key", FAULTY)
def test_a_faulty_sample_is_told_from_others_by_its_name_its_recipe_and_its_truth(key):
    ((frames, look, _),) = getattr(contributions, key)()
    metadata = look["metadata"]["fiberburst"]
    assert frames.shape == (20, 256, 256, 3)
    assert FAULTY[key] <= set(metadata)
    assert not {"frames", "axes", "white_level"} & set(metadata)
    faults = {name: value for name, value in metadata["recipe"].items() if name not in ("scene", "physics")}
    assert faults
    for name in faults:
        assert name.replace("_", " ") in look["name"]
    scene, physics = metadata["recipe"]["scene"], metadata["recipe"]["physics"]
    again = simulate(scene, physics=physics, faults=Faults(**faults))
    np.testing.assert_array_equal(again.arrays()["frames"], frames)


def test_the_sample_of_a_recording_makes_a_frame_when_it_is_shown(make_napari_viewer):
    tracemalloc.start()
    ((frames, look, _),) = contributions.recording_slide()
    np.asarray(frames[1233])
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < frames.size / 2  # while it was opened, too
    viewer = make_napari_viewer()
    layer = viewer.add_image(frames, **look)
    assert frames.shape == (2000, 256, 256)
    viewer.dims.set_current_step(0, 1234)
    shown = np.asarray(layer._slice.image.raw)
    np.testing.assert_array_equal(shown, frames[1234])
    assert not np.array_equal(shown, frames[1233])
    metadata = look["metadata"]["fiberburst"]
    assert metadata["homographies"].shape == (2000, 3, 3)
    assert 0 < (~metadata["in_contact"]).sum() < 50


@pytest.mark.parametrize("ending", [".burst", ".npz"])
def test_a_simulated_burst_opens_with_its_truth(tmp_path, simulated, ending):
    path = tmp_path / f"tissue{ending}"
    with path.open("wb") as stream:
        np.savez(stream, **simulated.arrays())
    ((frames, look, _),) = contributions.get_reader(str(path))(str(path))
    np.testing.assert_array_equal(frames, simulated.arrays()["frames"])
    assert look["rgb"]
    assert look["metadata"]["fiberburst"]["recording"] == {"channel_names": (), "times": ()}
    np.testing.assert_array_equal(look["metadata"]["fiberburst"]["homographies"], simulated.homographies)


def test_a_simulated_burst_that_is_dropped_on_the_window_opens(make_napari_viewer, npe2pm, tmp_path, simulated):
    """That of napari itself, which reads numpy's archives, must not be taken for it."""
    npe2pm.register(MANIFEST)
    npe2pm.register(PluginManifest.from_distribution("napari"))
    path = tmp_path / "tissue.burst"
    with path.open("wb") as stream:
        np.savez(stream, **simulated.arrays())
    viewer = make_napari_viewer()
    viewer.open(str(path), plugin=None)
    (layer,) = viewer.layers
    assert layer.source.reader_plugin == "napari-fiberburst"
    np.testing.assert_array_equal(layer.data, simulated.arrays()["frames"])
    assert "truth" in layer.metadata["fiberburst"]


def test_a_folder_of_frames_opens_as_a_stack(tmp_path, grey_frames):
    for number, frame in enumerate(grey_frames):
        tifffile.imwrite(tmp_path / f"frame{number}.tif", frame)
    ((frames, look, _),) = contributions.get_reader(str(tmp_path))(str(tmp_path))
    np.testing.assert_array_equal(frames, grey_frames)
    assert look["axis_labels"] == ("t", "y", "x")


def test_other_files_are_left_to_other_readers(tmp_path):
    assert contributions.get_reader(str(tmp_path)) is None
    assert contributions.get_reader(str(tmp_path / "image.tif")) is None
    assert contributions.get_reader(["a.npz", "b.npz"]) is None


def test_a_result_layer_is_written_with_its_provenance(open_dock, run_through, burst_layer, tmp_path):
    viewer, dock = open_dock(burst_layer)
    run_through(dock)
    layer = viewer.layers["run 1: image"]
    written = contributions.write(str(tmp_path / "out.ome.tif"), *layer.as_layer_data_tuple()[:2])
    assert written == [str(tmp_path / "out.ome.tif")]
    assert tifffile.imread(written[0]).shape == (3, 63, 75)
    assert json.loads((tmp_path / "out.json").read_text())["ending"] == "finished"
    # napari gives the writer other images too.
    dock.picture.display.card.switches["coverage"].setChecked(True)
    viewer.layers["run 1: coverage"].save(str(tmp_path / "coverage.ome.tif"))
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "coverage.ome.tif"), viewer.layers["run 1: coverage"].data)
    contributions.write(str(tmp_path / "b.ome.tif"), *burst_layer.as_layer_data_tuple()[:2])
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "b.ome.tif"), burst_layer.data)


def test_the_layers_menu_registers_and_reconstructs(make_napari_viewer, qtbot, burst_layer, npe2pm):
    npe2pm.register(MANIFEST)
    viewer = make_napari_viewer()
    viewer.add_layer(burst_layer)
    contributions.register_layer()
    (dock,) = viewer.window.dock_widgets.values()
    with qtbot.waitSignal(dock.picture.display.complete, timeout=60_000):
        pass
    assert viewer.layers["run 1: stabilised burst"].visible
    assert dock.picture.display.card.switches["stabilised burst"].isChecked()
    assert not viewer.layers["run 1: image"].visible


def test_preferences_come_from_naparis_page(plugin_settings, npe2pm):
    from napari.settings import get_plugin_settings

    assert preferences() == Preferences()
    npe2pm.register(MANIFEST)
    assert preferences() == Preferences()
    page = get_plugin_settings("napari-fiberburst").reconstruction
    page.preset, page.previews_per_second = "paper", 2.0
    assert preferences() == Preferences(preset="paper", previews_per_second=2.0)


def test_results_are_saved_from_the_list_of_runs(open_dock, run_through, burst_layer, tmp_path):
    _, dock = open_dock(burst_layer)
    run = run_through(dock)
    save_result(run, tmp_path / "p.ome.tif")
    save_homographies(run, tmp_path / "h.csv")
    save_homographies(run, tmp_path / "h.json")
    table = np.loadtxt(tmp_path / "h.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:, 1:].reshape(-1, 3, 3), run.result.homographies)
    stored = json.loads((tmp_path / "h.json").read_text())["frames"]
    np.testing.assert_array_equal([frame["homography"] for frame in stored], run.result.homographies)
    assert (tmp_path / "p.json").exists()
    before = sorted(tmp_path.iterdir())
    save_homographies(run, tmp_path / "h.txt")
    assert sorted(tmp_path.iterdir()) == before
