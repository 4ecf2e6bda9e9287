"""The dock while there is no burst."""

import numpy as np
import pytest
from napari.layers import Image
from napari.utils.notifications import notification_manager
from npe2 import PluginManifest
from qtpy.QtWidgets import QFileDialog
from skimage.io import imsave

from napari_fiberburst import reconstruct
from napari_fiberburst.simulation import simulate

MILLISECONDS = 60_000


def is_empty(dock):
    """Whether the dock offers to open a burst, and nothing else."""
    assert dock.empty.isHidden() == (dock.input.burst.value is not None)
    return dock.filled.isHidden()


def test_the_form_is_there_while_there_is_a_burst(open_dock, burst_layer):
    viewer, dock = open_dock()
    assert is_empty(dock)
    viewer.add_layer(burst_layer)
    assert not is_empty(dock)
    viewer.layers.clear()
    assert is_empty(dock)


def test_runs_stay_in_sight_when_their_burst_is_gone(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    run = run_through(dock)
    viewer.layers.clear()
    assert not is_empty(dock)
    dock.picture.runs.remove(run)
    assert not is_empty(dock), "it can be brought back"
    dock.picture.runs.undo_button.click()
    assert dock.picture.runs.run is run


@pytest.fixture
def files(tmp_path, ome_file, grey_frames):
    """Return a file or folder of each kind that a user can choose, with the number of its frames."""
    simulated = tmp_path / "simulated.burst"
    with simulated.open("wb") as stream:
        np.savez(stream, **simulate("histology", shape=(40, 48), frames=4, pitch=4.0).arrays())
    folder = tmp_path / "frames"
    folder.mkdir()
    for number, frame in enumerate(grey_frames):
        imsave(folder / f"frame {number}.png", frame, check_contrast=False)
    return {"tif": (ome_file, 8), "burst": (simulated, 4), "folder": (folder, 8)}


@pytest.mark.parametrize("kind", ["tif", "burst", "folder"])
def test_a_burst_is_opened_by_the_reader_of_the_command_line(open_dock, qtbot, monkeypatch, files, kind):
    path, frames = files[kind]
    viewer, dock = open_dock()
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (str(path), ""))
    monkeypatch.setattr(QFileDialog, "getExistingDirectory", lambda *_: str(path))
    (dock.empty.folder_button if kind == "folder" else dock.empty.open_button).click()
    assert not dock.empty.open_button.isEnabled()
    qtbot.waitUntil(lambda: not is_empty(dock), timeout=MILLISECONDS)
    source = dock.input.source()
    assert source.shape[0] == frames
    assert source.path == str(path)
    assert (source.truth is not None) == (kind == "burst")
    if kind == "tif":
        np.testing.assert_array_equal(viewer.layers[0].scale[-2:], [0.5, 0.25])
        burst = source.read()
        assert (burst.pixel_size, burst.unit, burst.channel_names) == ((0.5, 0.25), "µm", ("red", "green"))
        assert burst.times is not None


def test_a_saved_result_opens_as_the_layers_of_its_run_and_is_not_taken_for_a_burst(
    open_dock, qtbot, monkeypatch, burst_layer, tmp_path
):
    burst = simulate("histology", shape=(40, 48), frames=4, pitch=4.0).burst
    path = reconstruct(burst, preset="paper", iterations=1, batch=64).save(tmp_path / "tissue.fiberburst")
    viewer, dock = open_dock(burst_layer)
    asked = []
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *words: asked.append(words) or (str(path), ""))
    dock.input.burst_button.click()
    qtbot.waitUntil(lambda: len(viewer.layers) > 1, timeout=MILLISECONDS)
    assert "*.fiberburst" in asked[0][3]
    assert viewer.layers[1].name == "tissue: image"
    assert dock.input.burst.value is burst_layer


def test_a_file_that_is_no_burst_is_refused_in_words(open_dock, qtbot, tmp_path):
    viewer, dock = open_dock()
    path = tmp_path / "broken.tif"
    path.write_bytes(b"no TIFF")
    dock.empty.open(str(path))
    qtbot.waitUntil(lambda: dock.empty.open_button.isEnabled(), timeout=MILLISECONDS)
    assert "broken.tif" in dock.empty.words.text()
    assert not dock.empty.words.text().startswith("Opening")
    assert is_empty(dock)
    assert not viewer.layers


def test_another_burst_is_opened_beside_the_one_that_is_chosen_and_takes_its_place(
    open_dock, qtbot, monkeypatch, files, tmp_path, grey_frames
):
    path, frames = files["tif"]
    viewer, dock = open_dock(Image(grey_frames, name="first"))
    chosen = str(path)
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (chosen, ""))
    dock.input.burst_button.click()
    assert not dock.input.burst_button.isEnabled()
    qtbot.waitUntil(lambda: len(viewer.layers) == 2, timeout=MILLISECONDS)
    assert dock.input.burst.value is viewer.layers[1]
    assert dock.input.source().shape[0] == frames
    broken = tmp_path / "broken.tif"
    broken.write_bytes(b"no TIFF")
    chosen = str(broken)
    dock.input.burst_button.click()
    qtbot.waitUntil(dock.input.burst_button.isEnabled, timeout=MILLISECONDS)
    assert "broken.tif" in notification_manager.records[-1].message
    assert dock.input.burst.value is viewer.layers[1]


def test_every_sample_is_offered_and_the_one_chosen_is_simulated(open_dock, qtbot, npe2pm):
    manifest = PluginManifest.from_distribution("napari-fiberburst")
    npe2pm.register(manifest)
    viewer, dock = open_dock()
    dock.empty.samples.aboutToShow.emit()
    dock.empty.samples.aboutToShow.emit()
    offered = {action.text(): action for action in dock.empty.samples.actions()}
    assert list(offered) == [sample.display_name for sample in manifest.contributions.sample_data]
    offered["Histology, one value a core (core)"].trigger()
    qtbot.waitUntil(lambda: not is_empty(dock), timeout=MILLISECONDS)
    assert [layer.name for layer in viewer.layers] == ["histology (core)"]
    assert dock.input.source().truth is not None
