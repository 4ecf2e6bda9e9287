"""The dock as a user has it: one click, a picture; and whatever else may happen to it."""

import gc
import threading
import weakref

import dask.array as da
import numpy as np
import pytest
from napari.layers import Image, Labels, Shapes
from napari.utils import progress
from napari.utils.notifications import notification_manager

from napari_fiberburst import solver
from napari_fiberburst.plugin.dock import FiberBurstWidget

MILLISECONDS = 60_000
NETWORK = {"encoding": "fourier", "iterations": 400, "scene_width": 16, "scene_layers": 1, "features": 16, "batch": 64}
QUICK = {"preset": "paper", **NETWORK, "iterations": 2}


def notices_during(act):
    """Return the notifications that came while something was done."""
    before = len(notification_manager.records)
    act()
    return [record.message for record in list(notification_manager.records)[before:]]


def layer_of(viewer, kind):
    return next(layer for layer in viewer.layers if layer.name.endswith(f": {kind}"))


def test_one_click_makes_a_picture(open_dock, run_through, burst_layer, simulated):
    viewer, dock = open_dock(burst_layer)
    run = run_through(dock)
    assert run.result.ending == "finished"
    assert [layer.name for layer in viewer.layers] == [
        "burst",
        "run 1: stabilised burst",
        "run 1: coverage",
        "run 1: uncertainty",
        "run 1: transmission",
        "run 1: residuals",
        "run 1: picture",
        "run 1: frame outlines",
        "run 1: frame centres",
    ]
    shown = layer_of(viewer, "picture").data
    known = np.isfinite(run.result.image).all(axis=-1)
    np.testing.assert_allclose(shown[known][:, :3], np.clip(run.result.image[known] / 255, 0, 1), atol=1e-6)
    np.testing.assert_array_equal(shown[..., 3], known)
    assert run.scores.motion_error < 0.5
    assert run.scores.psnr > 20
    assert dock.start_button.isEnabled()
    assert not dock.stop_button.isEnabled()


def test_the_plugin_runs_the_same_reconstruction_as_a_script(open_dock, run_through, burst_layer, simulated):
    _, dock = open_dock(burst_layer)
    run = run_through(dock)
    headless = solver.reconstruct(simulated.arrays()["frames"])
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
        getattr(dock.runner, name).connect(lambda *_, name=name: seen.append(name))
    run_through(dock)
    assert seen[0] == "started"
    assert seen[-2:] == ["finished", "ready"]
    assert set(seen[1:-2]) == {"reported", "previewed"}


def test_a_stopped_run_keeps_what_it_has(open_dock, qtbot, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.form.set_choices({**NETWORK, "iterations": 100_000})
    seen = []
    for name in ("finished", "stopped", "failed", "ready"):
        getattr(dock.runner, name).connect(lambda *_, name=name: seen.append(name))
    with qtbot.waitSignal(dock.runner.previewed, timeout=MILLISECONDS):
        dock.start()
    with qtbot.waitSignal(dock.display.complete, timeout=MILLISECONDS):
        dock.stop_button.click()
    assert seen == ["stopped", "ready"]
    assert dock.runs.run.result.ending == "stopped"
    assert np.isfinite(dock.runs.run.result.image).any()


def test_a_paused_run_waits_and_goes_on(open_dock, qtbot, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.form.set_choices(NETWORK)
    with qtbot.waitSignal(dock.runner.reported, timeout=MILLISECONDS):
        dock.start()
    dock.pause_button.click()
    assert dock.runner.state == "paused"
    assert dock.pause_button.text() == "Continue"
    qtbot.wait(300)  # the step it was in
    points = len(dock.runner.job.curve)
    qtbot.wait(400)
    assert len(dock.runner.job.curve) == points
    with qtbot.waitSignal(dock.display.complete, timeout=MILLISECONDS):
        dock.pause_button.click()
    assert dock.runs.run.result.ending == "finished"


def test_sigma_can_be_turned_while_running(open_dock, qtbot, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.form.set_choices({**NETWORK, "sigma": 2.0})
    with qtbot.waitSignal(dock.runner.reported, timeout=MILLISECONDS):
        dock.start()
    rows = dock.form._rows
    assert rows["sigma"].isEnabled()
    assert rows["learning_rate"].isEnabled()
    assert not rows["features"].isEnabled()
    rows["sigma"]._editor.setValue(3.5)
    with qtbot.waitSignal(dock.display.complete, timeout=MILLISECONDS):
        pass
    assert dock.runs.run.result.settings.encoding.sigma == 3.5


def test_a_network_goes_on_for_more_steps(open_dock, qtbot, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.form.set_choices({"preset": "paper", **NETWORK, "iterations": 20})
    first = run_through(dock)
    with qtbot.waitSignal(dock.display.complete, timeout=MILLISECONDS):
        dock.continue_run(first, 15)
    assert dock.runs.run is not first
    assert len(dock.runs.run.result.losses) == 35


def test_a_spline_has_nothing_to_go_on_for(open_dock, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    run_through(dock)
    assert not dock.runs._continue.isEnabled()
    assert "solved to its end" in dock.runs._continue.toolTip()


def test_open_settings_say_what_was_chosen(open_dock, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    run = run_through(dock)
    chosen = run.result.settings.encoding.smoothness
    assert dock.form._rows["smoothness"]._auto.text() == f"auto ({chosen:.3g})"
    assert "smoothness" not in dock.form.choices()


@pytest.mark.parametrize(
    ("layers", "words"),
    [
        ([], "there is no burst"),
        ([Labels(np.ones((5, 20, 20), int))], "there is no burst"),
        ([Image(np.random.default_rng(0).random((30, 30)))], "needs the axes T, Y, X"),
    ],
)
def test_what_is_no_burst_is_refused_at_once(open_dock, layers, words):
    _, dock = open_dock(*layers)
    (notice,) = notices_during(dock.start)
    assert words in notice
    assert dock.runner.state == "ready"


def test_a_burst_with_nan_is_refused_in_one_notification(open_dock, qtbot, grey_frames):
    frames = grey_frames.astype(np.float32)
    frames[2, 5, 5] = np.nan
    viewer, dock = open_dock(Image(frames))
    before = len(notification_manager.records)
    with qtbot.waitSignal(dock.runner.ready, timeout=MILLISECONDS):
        dock.start()
    (notice,) = [record.message for record in list(notification_manager.records)[before:]]
    assert "frame 2 holds NaN" in notice
    assert len(viewer.layers) == 1
    assert not dock.runs.runs


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RuntimeError("the size of tensor a must match"), "the size of tensor a must match"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), "there was not enough memory"),
        (MemoryError(), "there was not enough memory"),
        (ZeroDivisionError("by zero"), "by zero"),
    ],
)
def test_an_error_in_the_solver_leaves_the_form_ready(open_dock, qtbot, burst_layer, monkeypatch, error, words):
    def broken(*args, **choices):
        raise error

    monkeypatch.setattr(solver, "reconstruct", broken)
    viewer, dock = open_dock(burst_layer)
    seen = []
    for name in ("finished", "stopped", "failed", "ready"):
        getattr(dock.runner, name).connect(lambda *_, name=name: seen.append(name))
    before = len(notification_manager.records)
    with qtbot.waitSignal(dock.runner.ready, timeout=MILLISECONDS):
        dock.start()
    (notice,) = [record.message for record in list(notification_manager.records)[before:]]
    assert words in notice
    assert seen == ["failed", "ready"]
    assert dock.start_button.isEnabled()
    assert not progress._all_instances
    assert not viewer.window._task_status_manager.is_busy()


def test_a_picture_without_numbers_is_a_failure(open_dock, qtbot, burst_layer, monkeypatch):
    right = solver.reconstruct

    def blind(*args, **choices):
        result = right(*args, **choices)
        result.image[:] = np.nan
        return result

    monkeypatch.setattr(solver, "reconstruct", blind)
    _, dock = open_dock(burst_layer)
    with qtbot.waitSignal(dock.runner.failed, timeout=MILLISECONDS) as failed:
        dock.start()
    assert "came to no numbers" in failed.args[0]


def test_start_twice_is_one_run(open_dock, qtbot, burst_layer):
    _, dock = open_dock(burst_layer)
    with qtbot.waitSignal(dock.display.complete, timeout=MILLISECONDS):
        dock.start()
        dock.start()
    assert len(dock.runs.runs) == 1


@pytest.mark.parametrize("deed", ["delete burst", "rename burst", "replace data", "delete picture"])
def test_layers_may_change_while_running(open_dock, qtbot, burst_layer, deed):
    viewer, dock = open_dock(burst_layer)
    with qtbot.waitSignal(dock.runner.previewed, timeout=MILLISECONDS):
        dock.start()
    if deed == "delete burst":
        viewer.layers.remove(burst_layer)
    elif deed == "rename burst":
        burst_layer.name = "another"
    elif deed == "replace data":
        burst_layer.data = np.zeros((3, 20, 20, 3), np.uint8)
    else:
        viewer.layers.remove(layer_of(viewer, "picture"))
    with qtbot.waitSignal(dock.display.complete, timeout=MILLISECONDS):
        pass
    names = [layer.name for layer in viewer.layers]
    assert dock.runs.run.result.ending == "finished"
    assert ("run 1: picture" in names) == (deed != "delete picture")
    assert "run 1: coverage" in names


def test_a_closed_dock_stops_its_run_and_a_hidden_one_does_not(open_dock, qtbot, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.form.set_choices({**NETWORK, "iterations": 100_000})
    seen = []
    dock.runner.ready.connect(lambda: seen.append("ready"))
    with qtbot.waitSignal(dock.runner.reported, timeout=MILLISECONDS):
        dock.start()
    dock.parent().hide()
    qtbot.wait(300)
    assert dock.runner.state == "running"
    job = dock.runner.job
    viewer.window.remove_dock_widget(dock.parent())
    assert job.control.stopped
    qtbot.waitUntil(lambda: not viewer.window._task_status_manager.is_busy(), timeout=MILLISECONDS)
    assert seen == []
    assert not progress._all_instances
    burst_layer.name = "renamed"  # nobody listens any more


def test_a_viewer_closed_while_running_ends_the_run(open_dock, qtbot, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.form.set_choices({**NETWORK, "iterations": 100_000})
    with qtbot.waitSignal(dock.runner.reported, timeout=MILLISECONDS):
        dock.start()
    threads = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    viewer.close()
    qtbot.waitUntil(lambda: not progress._all_instances, timeout=MILLISECONDS)
    qtbot.waitUntil(lambda: len(threading.enumerate()) <= len(threads) + 1, timeout=MILLISECONDS)


def test_two_docks_run_side_by_side(open_dock, qtbot, burst_layer):
    viewer, first = open_dock(burst_layer)
    second = FiberBurstWidget(viewer)
    viewer.window.add_dock_widget(second, name="second")
    with qtbot.waitSignals([first.display.complete, second.display.complete], timeout=MILLISECONDS):
        first.start()
        second.start()
    names = {layer.name for layer in viewer.layers}
    assert {"run 1: picture", "run 2: picture"} <= names


def test_many_starts_and_stops_leave_nothing_behind(open_dock, qtbot, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.form.set_choices({"preset": "paper", **NETWORK, "iterations": 100_000})
    qtbot.waitUntil(lambda: dock._missing is not None, timeout=MILLISECONDS)
    for _ in range(10):
        with qtbot.waitSignal(dock.runner.ready, timeout=MILLISECONDS):
            dock.start()
            dock.runner.stop()
        for run in dock.runs.runs:
            dock.runs.remove(run)
    qtbot.wait(100)
    assert not progress._all_instances
    assert [layer.name for layer in viewer.layers] == ["burst"]
    assert not dock.runner._timer.isActive()
    assert not viewer.window._task_status_manager.is_busy()


def test_what_a_removed_run_held_is_let_go(open_dock, run_through, qtbot, burst_layer):
    viewer, dock = open_dock(burst_layer)
    run = run_through(dock)
    gone = [weakref.ref(run.result), weakref.ref(layer_of(viewer, "picture"))]
    dock.runs.remove(run)
    del run
    qtbot.wait(50)
    gc.collect()
    assert [reference() for reference in gone] == [None, None]
    assert [layer.name for layer in viewer.layers] == ["burst"]


def test_the_form_is_as_it_was_left(open_dock, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.form.set_choices({"motion": "affine", "upsample": 2.0})
    again = FiberBurstWidget(viewer)
    assert again.form.choices() == {"motion": "affine", "upsample": 2.0}
    again.shut_down()


def test_a_region_limits_the_run(open_dock, run_through, burst_layer):
    corners = np.array([[5.0, 8.0], [5.0, 47.0], [40.0, 47.0], [40.0, 8.0]])
    viewer, dock = open_dock(burst_layer, Shapes([corners], shape_type="rectangle", name="look here"))
    dock.input.region.choose(viewer.layers["look here"])
    run = run_through(dock)
    picture = layer_of(viewer, "picture")
    assert run.result.image.shape == (36, 40, 3)
    np.testing.assert_array_equal(picture.translate, [5, 8])
    assert run.scores.motion_error < 0.7


def test_scale_units_and_labels_are_carried_over(open_dock, run_through, grey_frames):
    layer = Image(grey_frames, scale=(1, 0.5, 0.25), translate=(0, 10, 20), units=("s", "um", "um"))
    layer.axis_labels = ("t", "y", "x")
    viewer, dock = open_dock(layer)
    dock.form.set_choices({"upsample": 2.0})
    run = run_through(dock)
    picture, still = layer_of(viewer, "picture"), layer_of(viewer, "stabilised burst")
    assert run.result.acquisition.pixel_size == (0.5, 0.25)
    assert run.result.acquisition.unit == "µm"
    np.testing.assert_allclose(picture.scale, [0.25, 0.125])
    np.testing.assert_allclose(picture.translate, [10 - 0.125, 20 - 0.0625])  # pixel edges meet, not centres
    assert picture.axis_labels == ("y", "x")
    assert still.axis_labels == ("t", "y", "x")
    assert [str(unit) for unit in picture.units] == ["micrometer", "micrometer"]
    for own in ("frame outlines", "frame centres"):
        np.testing.assert_allclose(layer_of(viewer, own).scale, [1, 0.5, 0.25])


@pytest.mark.parametrize("order", ["TCYX", "CTYX"])
def test_channels_that_are_no_colours_stay_an_axis(open_dock, run_through, simulated, order):
    frames = simulated.arrays()["frames"][..., [0, 1]]
    viewer, dock = open_dock(Image(frames.transpose(["TYXC".index(axis) for axis in order])))
    assert dock.input.axes.text() == order
    run = run_through(dock)
    picture = layer_of(viewer, "picture")
    expected = np.moveaxis(run.result.image, 2, 0)
    shown = picture.data if order == "TCYX" else picture.data[:, 3]
    np.testing.assert_array_equal(shown, expected)
    assert layer_of(viewer, "stabilised burst").data.shape == viewer.layers[0].data.shape


def test_grey_layers_make_one_burst(open_dock, run_through, qtbot, simulated):
    frames = simulated.arrays()["frames"]
    names = ("red", "green")
    viewer, dock = open_dock(*(Image(frames[..., number], name=name) for number, name in enumerate(names)))
    dock.input.burst.choose(viewer.layers["red"])
    item = dock.input._channels.item(0)
    assert item.text() == "green"
    item.setCheckState(dock.input._channels.item(0).checkState().Checked)
    run = run_through(dock)
    assert run.result.image.shape == (63, 75, 2)
    assert run.result.acquisition.channel_names == names
    for number, name in enumerate(names):
        np.testing.assert_array_equal(layer_of(viewer, f"picture of {name}").data, run.result.image[..., number])


def test_a_dask_layer_is_a_burst(open_dock, run_through, grey_frames):
    viewer, dock = open_dock(Image(da.from_array(grey_frames, chunks=(1, 63, 75))))
    assert run_through(dock).result.image.shape == (63, 75)
    still = layer_of(viewer, "stabilised burst").data
    assert isinstance(still, da.Array)
    np.testing.assert_array_equal(still[0].compute(), grey_frames[0])


def test_more_than_fits_is_refused_with_a_reason(open_dock, grey_frames):
    _, dock = open_dock(Image(np.broadcast_to(grey_frames[:1], (10**6, 63, 75))))
    (notice,) = notices_during(dock.start)
    assert "GB of memory" in notice
    assert "draw a region" in notice
    assert dock.runner.state == "ready"


def test_the_history_goes_back_through_the_run(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    run = run_through(dock)
    assert len(run.history.moments) >= 2
    final = layer_of(viewer, "picture").data.copy()
    dock.display.slider.setValue(0)
    early = layer_of(viewer, "picture").data
    assert not np.array_equal(early, final)
    dock.display.slider.setValue(dock.display.slider.maximum())
    np.testing.assert_array_equal(layer_of(viewer, "picture").data, final)


def test_copied_python_is_the_exact_call(open_dock, qtbot, run_through, burst_layer, tmp_path, monkeypatch):
    from qtpy.QtWidgets import QApplication

    viewer, dock = open_dock(burst_layer)
    dock.form.set_choices({"motion": "affine", "upsample": 2.0})
    dock.copying.python.click()
    text = QApplication.clipboard().text()
    run = run_through(dock)
    assert viewer.layers["run 1: picture"].metadata["fiberburst"]["python"] == text
    monkeypatch.chdir(tmp_path)
    scope = {"viewer": viewer}
    exec(text, scope)
    np.testing.assert_allclose(scope["result"].image, run.result.image, rtol=1e-4)
    dock.copying.command.click()
    command = QApplication.clipboard().text()
    assert command.splitlines()[-1] == (
        "fiberburst reconstruct burst.npz -o picture.ome.tif --motion affine --upsample 2.0"
    )


def test_a_truth_that_fits_no_longer_is_let_go(open_dock, run_through, burst_layer):
    _, dock = open_dock(burst_layer)
    burst_layer.data = burst_layer.data[:5]
    run = run_through(dock)
    assert run.result.ending == "finished"
    assert run.scores is None


def test_axes_of_length_one_in_front_are_no_hindrance(open_dock, run_through, grey_frames):
    viewer, dock = open_dock(Image(grey_frames[None, None]))
    run = run_through(dock)
    np.testing.assert_array_equal(layer_of(viewer, "picture").data, run.result.image)
    assert layer_of(viewer, "frame centres").data.shape == (8, 4)


@pytest.mark.parametrize("axes", ["TYXQ", "CYXT"])
def test_axes_that_cannot_be_are_refused_before_the_run(open_dock, burst_layer, axes):
    _, dock = open_dock(burst_layer)
    dock.input.axes.setText(axes)
    (notice,) = notices_during(dock.start)
    assert "let them end in C" in notice
    assert dock.runner.state == "ready"


def test_a_menu_command_on_something_else_says_so(open_dock, burst_layer):
    labels = Labels(np.ones((5, 20, 20), int))
    _, dock = open_dock(burst_layer, labels)
    (notice,) = notices_during(lambda: dock.start_on(labels))
    assert "is no image that could be a burst" in notice
    assert dock.runner.state == "ready"


def test_a_continued_run_keeps_its_calibration_image(open_dock, qtbot, run_through, burst_layer, simulated):
    even = Image(np.repeat(255 * simulated.transmission[..., None], 3, axis=2), rgb=False, name="even")
    _, dock = open_dock(burst_layer, even)
    dock.input.burst.choose(burst_layer)
    dock.input.calibration.choose(even)
    dock.form.set_choices({**NETWORK, "iterations": 5})
    first = run_through(dock)
    with qtbot.waitSignal(dock.display.complete, timeout=MILLISECONDS):
        dock.continue_run(first, 5)
    python = dock.runs.run.python
    assert python.count("calibration=viewer.layers['even'].data") == 2
    assert python.count("initial=result") == 1


def test_a_renamed_run_renames_its_layers(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.form.set_choices(QUICK)
    run_through(dock)
    dock.runs._list.item(0).setText("sharp")
    assert "sharp: picture" in viewer.layers
    assert viewer.layers["sharp: picture"].metadata["fiberburst"]["run"] == "sharp"
    dock.runs._list.item(0).setText(" ")
    assert dock.runs._list.item(0).text() == "sharp"


def test_comparing_shows_one_picture_alone(open_dock, run_through, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.form.set_choices(QUICK)
    for _ in range(3):
        run_through(dock)
    dock.runs._list.setCurrentRow(0)
    dock.runs._other.setCurrentIndex(0)
    dock.runs._compare.click()
    assert [viewer.layers[f"run {number}: picture"].visible for number in (1, 2, 3)] == [False, True, False]
    dock.runs.remove(dock.runs.runs[1])
    assert not dock.runs._compare.isChecked()
    assert [viewer.layers[f"run {number}: picture"].visible for number in (1, 3)] == [True, False]


def test_animations_are_as_before_when_the_dock_is_closed(open_dock, qtbot, burst_layer):
    from qtpy.QtWidgets import QLabel

    viewer, dock = open_dock(burst_layer)
    window = dock.window()
    movies = [label.movie() for label in window.findChildren(QLabel) if label.movie() is not None]
    dock.form.set_choices({**NETWORK, "iterations": 100_000})
    with qtbot.waitSignal(dock.runner.reported, timeout=MILLISECONDS):
        dock.start()
    assert {movie.speed() for movie in movies} == {4}
    viewer.window.remove_dock_widget(dock.parent())
    assert {movie.speed() for movie in movies} == {100}
    qtbot.waitUntil(lambda: not viewer.window._task_status_manager.is_busy(), timeout=MILLISECONDS)


def test_a_dock_put_back_follows_the_layers_again(open_dock, burst_layer, grey_frames):
    viewer, dock = open_dock(burst_layer)
    viewer.window.remove_dock_widget(dock.parent())
    viewer.window.add_dock_widget(dock, name="again")
    viewer.add_layer(Image(grey_frames, name="late"))
    assert dock.input.burst.findText("late") >= 0
