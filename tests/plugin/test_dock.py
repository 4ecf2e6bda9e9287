"""The dock as a user has it: one click, an image; and whatever else may happen to it."""

from html import escape

import numpy as np
import pytest
from napari.layers import Image
from pyqtgraph import PlotWidget
from qtpy.QtCore import Qt
from scipy.ndimage import gaussian_filter

from napari_fiberburst.pipeline import reconstruct as pipeline
from napari_fiberburst.plugin.dock import FiberBurstWidget
from napari_fiberburst.plugin.preferences import Preferences
from napari_fiberburst.plugin.stacks import stabilised
from napari_fiberburst.plugin.tasks import picture as picture_task
from napari_fiberburst.simulation import Camera, Faults, simulate

MILLISECONDS = 60_000
NETWORK = {"encoding": "fourier", "iterations": 400, "scene_width": 16, "scene_layers": 1, "features": 16, "batch": 64}
QUICK = {"preset": "paper", **NETWORK, "iterations": 2}


def test_one_click_makes_an_image(open_dock, run_through, burst_layer, simulated):
    viewer, dock = open_dock(burst_layer)
    run = run_through(dock, afresh=True)
    assert run.result.ending == "finished"
    assert [layer.name for layer in viewer.layers] == ["burst", "run 1: image"]
    shown = viewer.layers["run 1: image"].data
    known = np.isfinite(run.result.image).all(axis=-1)
    np.testing.assert_allclose(shown[known][:, :3], np.clip(run.result.image[known] / 255, 0, 1), atol=1e-6)
    np.testing.assert_array_equal(shown[..., 3], known)
    assert run.scores.motion_error < 0.5
    assert run.scores.psnr > 20
    assert dock.picture.start_button.isEnabled()
    assert not dock.picture.stop_button.isEnabled()


def test_the_plugin_runs_the_same_reconstruction_as_a_script(open_dock, run_through, burst_layer, simulated):
    _, dock = open_dock(burst_layer)
    run = run_through(dock, afresh=True)
    headless = pipeline.reconstruct(simulated.arrays()["frames"])
    # Sums in another thread may be taken in another order.
    np.testing.assert_allclose(run.result.image, headless.image, rtol=1e-4)
    np.testing.assert_allclose(run.result.homographies, headless.homographies, atol=1e-6)


def test_the_camera_the_slider_and_the_selection_stay(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    viewer.dims.set_point(0, 2)
    camera = viewer.scene.camera
    camera.zoom, camera.center = 3.25, (0.0, 11.0, 13.0)
    viewer.layers.selection.active = burst_layer
    run_through(dock)
    assert viewer.dims.point[0] == 2
    assert camera.zoom == 3.25
    assert camera.center == (0.0, 11.0, 13.0)
    assert viewer.layers.selection.active is burst_layer


def test_the_signals_of_a_finished_run_come_in_order(open_dock, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    seen = []
    for name in ("started", "reported", "previewed", "finished", "stopped", "failed", "ready"):
        getattr(dock.picture.runner, name).connect(lambda *_, name=name: seen.append(name))
    run_through(dock, afresh=True)
    assert seen[0] == "started"
    assert seen[-2:] == ["finished", "ready"]
    assert set(seen[1:-2]) == {"reported", "previewed"}


def test_a_stopped_run_keeps_what_it_has(open_dock, qtbot, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({**NETWORK, "iterations": 100_000})
    seen = []
    for name in ("finished", "stopped", "failed", "ready"):
        getattr(dock.picture.runner, name).connect(lambda *_, name=name: seen.append(name))
    with qtbot.waitSignal(dock.picture.runner.previewed, timeout=MILLISECONDS):
        dock.picture.start()
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        dock.picture.stop_button.click()
    assert seen == ["stopped", "ready"]
    assert dock.picture.runs.run.result.ending == "stopped"
    assert np.isfinite(dock.picture.runs.run.result.image).any()


def test_a_paused_run_waits_and_goes_on(open_dock, qtbot, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.picture.form.set_choices(NETWORK)
    with qtbot.waitSignal(dock.picture.runner.reported, timeout=MILLISECONDS):
        dock.picture.start()
    dock.picture.pause_button.click()
    assert dock.picture.runner.state == "paused"
    assert dock.picture.pause_button.text() == "Continue"
    qtbot.wait(300)  # the step it was in
    points = len(dock.picture.runner.job.curve)
    qtbot.wait(400)
    assert len(dock.picture.runner.job.curve) == points
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        dock.picture.pause_button.click()
    assert dock.picture.runs.run.result.ending == "finished"


def test_sigma_can_be_turned_while_running(open_dock, qtbot, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({**NETWORK, "sigma": 2.0})
    with qtbot.waitSignal(dock.picture.runner.reported, timeout=MILLISECONDS):
        dock.picture.start()
    rows = dock.picture.form.rows
    assert rows["sigma"].isEnabled()
    assert rows["learning_rate"].isEnabled()
    assert not rows["features"].isEnabled()
    rows["sigma"].editor.value = 3.5
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        pass
    assert dock.picture.runs.run.result.settings.method.encoding.sigma == 3.5


def test_a_network_goes_on_for_more_steps(open_dock, qtbot, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({"preset": "paper", **NETWORK, "iterations": 20})
    first = run_through(dock)
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        dock.picture.continue_run(first, 15)
    assert dock.picture.runs.run is not first
    assert len(dock.picture.runs.run.result.losses) == 35


def test_a_spline_has_nothing_to_go_on_for(open_dock, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    run_through(dock)
    assert not dock.picture.runs.continue_button.isEnabled()
    assert "solved to its end" in dock.picture.runs.continue_button.toolTip()


def test_open_settings_say_what_was_chosen(open_dock, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    run = run_through(dock)
    chosen = run.result.settings.method.smoothness
    assert dock.picture.form.rows["smoothness"].auto.text() == f"auto ({chosen:.3g})"
    assert "smoothness" not in dock.picture.form.choices()


def test_the_form_is_as_it_was_left(open_dock, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({"motion": "affine", "upsample": 2.0})
    again = FiberBurstWidget(viewer)
    assert again.picture.form.choices() == {"motion": "affine", "upsample": 2.0}
    again.shut_down()


def test_what_is_remembered_is_told_with_one_click_back(open_dock, burst_layer, grey_frames):
    viewer, dock = open_dock(burst_layer)
    assert dock.picture.departures.isHidden()
    dock.picture.form.set_choices({"preset": "paper", "sigma": 2.0})
    assert dock.picture.departures.words.text() == "set: paper, sigma 2.0"
    again = FiberBurstWidget(viewer)
    assert not again.picture.departures.isHidden()
    assert again.picture.departures.words.text() == "as last time: paper, sigma 2.0"
    again.picture.departures.back_button.click()
    assert again.picture.form.choices() == {}
    assert again.picture.departures.isHidden()
    again.shut_down()
    # Nor is it told less where the next burst comes in the same window.
    dock.input.burst.value = viewer.add_layer(Image(grey_frames, name="next"))
    assert dock.picture.departures.words.text() == "as last time: paper, sigma 2.0"


def test_a_preset_that_is_preferred_needs_no_word(open_dock, burst_layer, monkeypatch):
    monkeypatch.setattr(picture_task, "preferences", lambda: Preferences(preset="paper"))
    _, dock = open_dock(burst_layer)
    assert dock.picture.form.choices() == {"preset": "paper"}
    assert dock.picture.departures.isHidden()
    dock.picture.form.set_choices({"device": "cpu"})
    assert dock.picture.departures.words.text() == "set: auto, device cpu"


def test_curves_are_those_of_the_run_selected_whenever_they_are_opened(open_dock, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.picture.form.set_choices(QUICK)
    first = run_through(dock)
    dock.picture.form.set_choices({**QUICK, "iterations": 4})
    second = run_through(dock)

    def drawn():
        (plot,) = [
            plot
            for plot in dock.picture.display.curve_box.findChildren(PlotWidget)
            if plot.getAxis("left").labelText == "loss"
        ]
        return plot.listDataItems()[0].getOriginalDataset()[0] if plot.listDataItems() else []

    dock.picture.display.curve_box.expand(animate=False)
    np.testing.assert_array_equal(drawn(), [point.seconds for point in second.curve if np.isfinite(point.loss)])
    dock.picture.runs.select(first)
    np.testing.assert_array_equal(drawn(), [point.seconds for point in first.curve if np.isfinite(point.loss)])
    assert len(drawn()) > 0
    dock.picture.runs.remove(first)
    dock.picture.runs.remove(second)
    assert len(drawn()) == 0


def test_the_history_goes_back_through_the_run(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    run = run_through(dock, afresh=True)
    assert len(run.history.entries) >= 2
    final = viewer.layers["run 1: image"].data.copy()
    dock.picture.display.slider.setValue(0)
    early = viewer.layers["run 1: image"].data
    assert not np.array_equal(early, final)
    dock.picture.display.slider.setValue(dock.picture.display.slider.maximum())
    np.testing.assert_array_equal(viewer.layers["run 1: image"].data, final)


def test_copied_python_is_the_exact_call(open_dock, qtbot, run_through, burst_layer, tmp_path, monkeypatch):
    from qtpy.QtWidgets import QApplication

    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({"motion": "affine", "upsample": 1.5})
    dock.picture.copying.python.click()
    text = QApplication.clipboard().text()
    run = run_through(dock)
    assert viewer.layers["run 1: image"].metadata["fiberburst"]["python"] == text
    monkeypatch.chdir(tmp_path)
    scope = {"viewer": viewer}
    exec(text, scope)
    np.testing.assert_allclose(scope["result"].image, run.result.image, rtol=1e-4)
    dock.picture.copying.command.click()
    command = QApplication.clipboard().text()
    assert command.splitlines()[-1] == (
        "fiberburst reconstruct simulated.burst -o image.ome.tif --motion affine --upsample 1.5"
    )


def test_a_continued_run_keeps_its_calibration_image(open_dock, qtbot, run_through, burst_layer, simulated):
    even = Image(np.repeat(255 * simulated.transmission[..., None], 3, axis=2), rgb=False, name="even")
    _, dock = open_dock(burst_layer, even)
    dock.input.burst.value = burst_layer
    dock.input.bundle.value = even
    dock.picture.form.set_choices({**NETWORK, "iterations": 5})
    first = run_through(dock)
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        dock.picture.continue_run(first, 5)
    python = dock.picture.runs.run.python
    assert python.count("calibration=viewer.layers['even'].data") == 2
    assert python.count("initial=result") == 1


def test_a_renamed_run_renames_its_layers(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices(QUICK)
    run_through(dock)
    dock.picture.runs.table.item(0, 0).setText("sharp")
    assert "sharp: image" in viewer.layers
    assert viewer.layers["sharp: image"].metadata["fiberburst"]["run"] == "sharp"
    dock.picture.runs.table.item(0, 0).setText(" ")
    assert dock.picture.runs.table.item(0, 0).text() == "sharp"


def switch(dock, *kinds, on=True):
    for kind in kinds:
        dock.picture.display.card.switches[kind].setChecked(on)


def offered(dock):
    return [kind for kind, box in dock.picture.display.card.switches.items() if not box.isHidden()]


def test_each_switch_makes_its_layer_and_takes_it_away(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    assert dock.picture.display.card.isHidden()
    run = run_through(dock)
    assert offered(dock) == [
        "outlines",
        "path",
        "coverage",
        "frames",
        "uncertainty",
        "transmission",
        "residuals",
        "stabilised burst",
    ]
    for kind in offered(dock):
        switch(dock, kind)
        layer = viewer.layers[f"run 1: {kind}"]
        assert layer.visible
        assert layer.metadata["fiberburst"]["run"] == "run 1"
        # What is asked for is seen: no image of the run lies over it.
        assert viewer.layers.index(layer) > viewer.layers.index("run 1: image")
        assert len(viewer.layers) == 3
        switch(dock, kind, on=False)
        assert [layer.name for layer in viewer.layers] == ["burst", "run 1: image"]
    assert viewer.layers["run 1: image"].metadata["fiberburst"]["reconstruction"] is run.result


def test_the_card_says_what_came_of_the_run(open_dock, run_through, grey_frames):
    _, dock = open_dock(Image(grey_frames, scale=(1, 0.5, 0.5), units=("s", "um", "um")))
    result = run_through(dock).result
    words = dock.picture.display.card.words.text()
    assert f"{result.quality}</b>" in words
    assert f"finest detail {result.resolution:.1f} px = {result.resolution / 2:.3g} µm" in words
    assert f"{len(result.frames_used)} of 8 frames" in words
    assert f"{100 * (result.coverage == 0).mean():.1f}% filled in" in words
    assert f"finished in {result.seconds:.1f} s" in words
    for note in result.notes:
        assert escape(note) in dock.picture.display.card.notes.text()


def test_a_layer_that_a_user_deletes_is_switched_off(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    run_through(dock)
    switch(dock, "coverage")
    viewer.layers.remove("run 1: coverage")
    assert not dock.picture.display.card.switches["coverage"].isChecked()
    switch(dock, "coverage")
    assert "run 1: coverage" in viewer.layers


def test_outlines_can_be_seen_while_a_run_goes_and_follow_it(open_dock, qtbot, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({**NETWORK, "iterations": 100_000})
    with qtbot.waitSignal(dock.picture.runner.previewed, timeout=MILLISECONDS):
        dock.picture.start()
    qtbot.waitUntil(lambda: offered(dock) == ["outlines", "path"], timeout=MILLISECONDS)
    switch(dock, "outlines", "path")
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        dock.picture.stop_button.click()
    homographies = dock.picture.runs.run.result.homographies
    corner = homographies[3] @ [-0.5, -0.5, 1]
    (outline,) = [shape for shape in viewer.layers["run 1: outlines"].data if shape[0, 0] == 3]
    np.testing.assert_allclose(outline[0, 1:], (corner[:2] / corner[2])[::-1], atol=1e-6)
    assert len(viewer.layers["run 1: path"].data) == 8


def test_only_the_newest_run_outlines_its_frames(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices(QUICK)
    run_through(dock)
    switch(dock, "outlines", "path")
    run_through(dock)
    assert [layer.name for layer in viewer.layers] == ["burst", "run 1: image", "run 2: image"]


def test_the_list_of_runs_shows_the_newest_first(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices(QUICK)
    for _ in range(3):
        run_through(dock, afresh=True)
    table = dock.picture.runs.table
    first, second, third = dock.picture.runs.runs

    def listed():
        return [table.item(row, 0).text() for row in range(table.rowCount())]

    assert listed() == ["run 3", "run 2", "run 1"]
    assert dock.picture.runs.run is third
    dock.picture.runs.select(first)
    switch(dock, "path")
    assert "run 1: path" in viewer.layers
    dock.picture.runs.select(third)
    assert not dock.picture.display.card.switches["path"].isChecked()
    # Sorted by what a heading says, rows are still those of their runs.
    seconds = {run.name: run.result.seconds for run in (first, second, third)}
    table.sortByColumn(2, Qt.SortOrder.AscendingOrder)
    assert [round(seconds[name], 1) for name in listed()] == sorted(round(value, 1) for value in seconds.values())
    assert dock.picture.runs.run is third
    table.sortByColumn(0, Qt.SortOrder.AscendingOrder)
    assert listed() == ["run 1", "run 2", "run 3"]
    dock.picture.runs.select(second)
    dock.picture.runs.remove_button.click()
    assert listed() == ["run 1", "run 3"]
    assert "run 2: image" not in viewer.layers


def test_a_row_tells_what_came_of_its_run(open_dock, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    result = run_through(dock).result
    cells = [dock.picture.runs.table.item(0, column).text() for column in range(5)]
    assert cells[:2] == ["run 1", "spline"]
    assert float(cells[2]) == round(result.seconds, 1)
    assert cells[3] == result.quality
    assert float(cells[4]) == pytest.approx(result.held_out_rmse, rel=0.01)


def test_a_burst_that_bends_is_drawn_as_it_bends_and_judged(open_dock, run_through):
    bent = simulate(
        "histology",
        shape=(131, 147),
        frames=10,
        channels=1,
        physics="core",
        pitch=4.7,
        seed=1,
        camera=Camera(photons=8000, bits=10, exposure=0.8),
        faults=Faults(deformation=4, intruder=0.08),
    )
    frames = bent.arrays()["frames"][..., 0]
    viewer, dock = open_dock(Image(frames, name="burst"))
    run = run_through(dock)
    result = run.result
    assert result.bends
    switch(dock, "displacement", "outlines", "stabilised burst")
    arrows = viewer.layers["run 1: displacement"]
    drawn = arrows.data[arrows.data[:, 0, 0] == 4, 1, 1:]
    rms = np.sqrt((result.displacement(4) ** 2).sum(axis=-1).mean())
    assert 0.5 * rms < np.sqrt((drawn**2).sum(axis=1).mean()) < 2 * rms
    outline = [shape for shape in viewer.layers["run 1: outlines"].data if shape[0, 0] == 4]
    assert len(outline[0]) > 4
    # Moved into place by all of its motion, a frame lies better on the object than by its homography alone.
    still = np.asarray(viewer.layers["run 1: stabilised burst"].data[4], dtype=np.float64)
    plain = np.asarray(stabilised(frames, result.homographies, result.canvas)[4], dtype=np.float64)
    inner = (slice(20, -20), slice(20, -20))
    truth = gaussian_filter(bent.truth[0, ..., 0], 4)[inner]
    alike = [np.corrcoef(gaussian_filter(moved, 4)[inner].ravel(), truth.ravel())[0, 1] for moved in (still, plain)]
    assert alike[0] > alike[1]
    assert result.outliers.any() == ("left out" in offered(dock))
    assert f">{result.quality}</b>" in dock.picture.display.card.words.text()
