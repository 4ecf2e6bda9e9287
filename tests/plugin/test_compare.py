"""Comparing two images: what is seen while it lasts, and that it leaves no trace."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Image

from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.plugin.runs import RunsPanel

HEIGHT, WIDTH = 31, 37
FIELD = Canvas.over((0, 0, WIDTH, HEIGHT))
# Twice as fine, and two pixels further to the left and three to the bottom.
FINER = Canvas.over((-2, 0, WIDTH, HEIGHT + 3), scale=2)


def ramp(canvas, colours=(), slope=1.0):
    """Return an image that is 100 + slope x (x + 2 y) at each frame pixel (x, y), more in later channels."""
    points = canvas.points()
    values = 100 + slope * (points[..., 0] + 2 * points[..., 1])
    image = values if not colours else values[..., None] + 10 * np.arange(colours[0])
    return image.astype(np.float32)


@pytest.fixture
def grey(viewer, panel, kept_run, tiny_simulation, grey_result):
    """Return viewer, panel and two runs of one grey burst: ramps, the first on a finer and larger canvas."""
    burst = viewer.add_layer(Image(tiny_simulation.arrays()["frames"][..., 1], name="burst", scale=(1, 0.5, 0.25)))
    results = [
        replace(grey_result, image=ramp(FINER, slope=1), canvas=FINER),
        replace(grey_result, image=ramp(FIELD, slope=2), canvas=FIELD),
    ]
    runs = [kept_run(viewer, [burst], "TYX", result, f"run {number}") for number, result in enumerate(results, 1)]
    for run in runs:
        panel.add(run)
    return viewer, panel, runs


def press(viewer, panel, way, other):
    """Choose and press as a user does; return the temporary layers, top first."""
    compare = panel.compare
    names = {layer.name for layer in viewer.layers}
    compare.way.setCurrentText(way)
    compare.other.setCurrentText(other)
    compare.button.click()
    return [layer for layer in reversed(viewer.layers) if layer.name not in names]


def shown(viewer):
    return [layer.name for layer in viewer.layers if layer.visible]


BEFORE = ["burst", "run 1: image", "run 2: image"]


def test_one_flickers_with_the_other(grey):
    viewer, panel, runs = grey
    press(viewer, panel, "flicker", "run 1")
    assert shown(viewer) == ["A, run 2"]
    assert panel.compare.flip.text() == "shown: A, run 2"
    panel.compare.flip.click()
    assert shown(viewer) == ["B, run 1"]
    assert panel.compare.flip.text() == "shown: B, run 1"
    np.testing.assert_array_equal(viewer.layers["B, run 1"].data, runs[0].result.image)
    # Each where it lies, and at the same contrast.
    np.testing.assert_allclose(viewer.layers["B, run 1"].scale, runs[0].layers.images[0].scale)
    assert viewer.layers["B, run 1"].contrast_limits == viewer.layers["A, run 2"].contrast_limits
    panel.compare.button.click()
    assert shown(viewer) == BEFORE
    assert len(viewer.layers) == 3


def test_a_curtain_has_a_left_of_its_line_and_b_right_of_it(grey):
    viewer, panel, runs = grey
    (layer,) = press(viewer, panel, "curtain", "run 1")
    assert shown(viewer) == [layer.name]
    for column in (0, 11, WIDTH):
        panel.compare.line.setValue(column)
        np.testing.assert_array_equal(layer.data[:, :column], runs[1].result.image[:, :column])
        # B is resampled: a ramp is the same at any scale.
        np.testing.assert_allclose(layer.data[:, column:], ramp(FIELD, slope=1)[:, column:], atol=0.01)
    panel.compare.button.click()
    assert shown(viewer) == BEFORE
    assert len(viewer.layers) == 3


def test_what_b_does_not_reach_is_left_open(grey):
    viewer, panel, runs = grey
    panel.select(runs[0])
    (layer,) = press(viewer, panel, "difference", "run 2")
    assert layer.data.shape == FINER.shape
    points = FINER.points()
    inside = (points[..., 0] > -0.5) & (points[..., 1] < HEIGHT - 0.5)
    np.testing.assert_array_equal(np.isfinite(layer.data), inside)
    inner = inside & (points.min(axis=-1) >= 0) & (points[..., 0] <= WIDTH - 1) & (points[..., 1] <= HEIGHT - 1)
    np.testing.assert_allclose(layer.data[inner], (ramp(FINER, slope=1) - ramp(FINER, slope=2))[inner], atol=0.01)


def test_a_difference_is_signed_and_its_colours_symmetric(grey):
    viewer, panel, _ = grey
    (layer,) = press(viewer, panel, "difference", "run 1")
    np.testing.assert_allclose(layer.data, ramp(FIELD, slope=2) - ramp(FIELD, slope=1), atol=0.01)
    low, high = layer.contrast_limits
    assert low == -high
    assert high == pytest.approx(WIDTH + 2 * HEIGHT, rel=0.05)
    blue, white, red = layer.colormap.map(np.array([0, 0.5, 1]))
    assert blue[2] > blue[0]
    assert red[0] > red[2]
    np.testing.assert_allclose(white[:3], white[0], atol=1e-6)
    assert "A, run 2, minus B, run 1" in panel.compare.words.text()
    panel.compare.button.click()
    assert shown(viewer) == BEFORE


def test_both_stand_side_by_side_and_the_view_comes_back(grey):
    viewer, panel, _ = grey
    grid, camera = viewer.canvas.grid, viewer.scene.camera
    grid.stride, camera.zoom = 2, 3.0
    press(viewer, panel, "side by side", "run 1")
    assert shown(viewer) == ["B, run 1", "A, run 2"]
    where = {layer.name: grid.position(number, viewer.layers) for number, layer in enumerate(viewer.layers)}
    assert (where["A, run 2"], where["B, run 1"]) == ((0, 0), (0, 1))
    assert grid.actual_shape(viewer.layers) == (1, 2)
    assert camera.zoom == 1.5
    panel.compare.button.click()
    assert (grid.enabled, grid.stride, grid.shape, camera.zoom) == (False, 2, (-1, -1), 3.0)
    assert shown(viewer) == BEFORE


@pytest.mark.parametrize("way", ["flicker", "curtain", "side by side", "difference"])
def test_the_burst_as_recorded_is_compared_with_what_came_of_it(grey, tiny_simulation, way):
    viewer, panel, _ = grey
    layers = press(viewer, panel, way, "as recorded")
    frame = tiny_simulation.arrays()["frames"][0, ..., 1].astype(np.float32)
    if way == "curtain":
        panel.compare.line.setValue(0)
    wanted = ramp(FIELD, slope=2) - frame if way == "difference" else frame
    np.testing.assert_allclose(layers[-1].data, wanted, atol=1e-4)
    np.testing.assert_allclose(layers[-1].scale, (0.5, 0.25))
    panel.compare.button.click()
    assert shown(viewer) == BEFORE


def test_a_run_of_a_region_is_compared_where_it_lies(grey, kept_run, grey_result):
    """Its pixels count from the region's corner."""
    viewer, panel, _ = grey
    region = ((4, 4 + 20), (6, 6 + 18))
    image = ramp(FIELD, slope=2)[4:24, 6:24]
    of_region = replace(grey_result, image=image, canvas=Canvas.over((0, 0, 18, 20)))
    panel.add(kept_run(viewer, [viewer.layers["burst"]], "TYX", of_region, "run 3", region=region))
    (layer,) = press(viewer, panel, "difference", "run 2")
    np.testing.assert_allclose(layer.data, 0, atol=1e-4)


def test_another_way_and_another_image_are_taken_up_at_once(grey):
    viewer, panel, _ = grey
    press(viewer, panel, "flicker", "run 1")
    compare = panel.compare
    compare.way.setCurrentText("difference")
    compare.way.activated.emit(compare.way.currentIndex())
    assert shown(viewer) == ["run 2 - run 1"]
    compare.other.setCurrentText("as recorded")
    compare.other.activated.emit(compare.other.currentIndex())
    assert shown(viewer) == ["run 2 - as recorded"]
    assert compare.flip.isHidden()
    assert compare.button.isChecked()


def test_colours_are_compared(viewer, panel, kept_run, tiny_simulation, colour_result):
    burst = viewer.add_layer(Image(tiny_simulation.arrays()["frames"], rgb=True, name="burst"))
    for number in (1, 2):
        result = replace(colour_result, image=ramp(FIELD, (3,), slope=number), canvas=FIELD)
        panel.add(kept_run(viewer, [burst], "TYXC", result, f"run {number}"))
    (layer,) = press(viewer, panel, "curtain", "run 1")
    panel.compare.line.setValue(5)
    left, right = (viewer.layers[f"run {number}: image"].data for number in (2, 1))
    assert layer.rgb
    np.testing.assert_array_equal(layer.data, np.concatenate([left[:, :5], right[:, 5:]], axis=1))
    panel.compare.button.click()
    (layer,) = press(viewer, panel, "difference", "run 1")
    np.testing.assert_allclose(layer.data, ramp(FIELD, slope=2) - ramp(FIELD, slope=1), atol=0.01)
    assert "mean of the channels" in panel.compare.words.text()


def test_a_channel_axis_stays_one(viewer, panel, kept_run, tiny_simulation, colour_result):
    burst = viewer.add_layer(Image(tiny_simulation.arrays()["frames"].transpose(0, 3, 1, 2), name="burst"))
    for number in (1, 2):
        result = replace(colour_result, image=ramp(FIELD, (3,), slope=number), canvas=FIELD)
        panel.add(kept_run(viewer, [burst], "TCYX", result, f"run {number}"))
    left, right = (np.moveaxis(ramp(FIELD, (3,), slope=slope), -1, 0) for slope in (2, 1))
    (layer,) = press(viewer, panel, "curtain", "run 1")
    panel.compare.line.setValue(5)
    np.testing.assert_array_equal(layer.data, np.concatenate([left[..., :5], right[..., 5:]], axis=-1))
    panel.compare.button.click()
    (layer,) = press(viewer, panel, "difference", "run 1")
    np.testing.assert_allclose(layer.data, left - right, atol=1e-4)


def test_channels_in_layers_of_their_own_are_compared(viewer, panel, kept_run, tiny_simulation, colour_result):
    frames = tiny_simulation.arrays()["frames"]
    burst = [viewer.add_layer(Image(frames[..., number], name=f"channel {number}")) for number in range(3)]
    for number in (1, 2):
        result = replace(colour_result, image=ramp(FIELD, (3,), slope=number), canvas=FIELD)
        panel.add(kept_run(viewer, burst, "TYX", result, f"run {number}"))
    layers = press(viewer, panel, "curtain", "run 1")
    panel.compare.line.setValue(5)
    assert len(layers) == 3
    for number, layer in enumerate(reversed(layers)):
        left, right = (ramp(FIELD, (3,), slope=slope)[..., number] for slope in (2, 1))
        np.testing.assert_array_equal(layer.data, np.concatenate([left[:, :5], right[:, 5:]], axis=1))
        assert layer.blending == "additive"
    panel.compare.button.click()
    layers = press(viewer, panel, "side by side", "run 1")
    where = [viewer.canvas.grid.position(viewer.layers.index(layer), viewer.layers) for layer in layers]
    assert where == 3 * [(0, 0)] + 3 * [(0, 1)]
    panel.compare.button.click()
    (layer,) = press(viewer, panel, "difference", "run 1")
    np.testing.assert_allclose(layer.data, ramp(FIELD, slope=2) - ramp(FIELD, slope=1), atol=0.01)


def test_what_cannot_be_compared_says_why(grey, kept_run, grey_result, colour_result, tiny_simulation):
    viewer, panel, runs = grey
    colour = viewer.add_layer(Image(tiny_simulation.arrays()["frames"], rgb=True, name="colour"))
    others = [kept_run(viewer, [colour], "TYXC", colour_result, "run 3")]
    far = Canvas.over((500, 500, 520, 520))
    late = replace(grey_result, image=ramp(FIELD), canvas=FIELD, reference=3)
    for name, result in (("run 4", replace(grey_result, image=ramp(far), canvas=far)), ("run 5", late)):
        others.append(kept_run(viewer, [viewer.layers["burst"]], "TYX", result, name))
    going = kept_run(viewer, [viewer.layers["burst"]], "TYX", late, "run 6")
    going.result = None
    for run in (*others, going):
        panel.add(run)
    assert not panel.compare.button.isEnabled()  # the run that is selected has no image yet
    panel.select(runs[1])
    before = shown(viewer)
    for other, said in (
        ("run 3", "channels must be as many in both, got 1 in run 2 and 3 in run 3"),
        ("run 4", "run 2 and run 4 have no place in common"),
        ("run 5", "run 2 lies over frame 0 and run 5 over frame 3"),
        ("run 6", "run 6 has no result yet"),
    ):
        for way in ("curtain", "difference"):
            assert press(viewer, panel, way, other) == []
            assert said in panel.compare.words.text()
            assert not panel.compare.button.isChecked()
            assert shown(viewer) == before
    assert [layer.name for layer in press(viewer, panel, "side by side", "run 3")] == ["A, run 2", "B, run 3"]


@pytest.mark.parametrize("way", ["flicker", "side by side"])
@pytest.mark.parametrize(
    "deed",
    ["select", "remove", "remove other", "rename", "add", "switch", "delete image", "delete shown", "delete all"],
)
def test_whatever_happens_ends_it_without_a_trace(grey, kept_run, qtbot, way, deed):
    viewer, panel, runs = grey
    viewer.layers["burst"].visible = False
    press(viewer, panel, way, "run 1")
    left = ["run 1: image", "run 2: image"]
    match deed:
        case "select":
            panel.select(runs[0])
        case "remove":
            panel.remove(runs[1])
            left = ["run 1: image"]
        case "remove other":
            panel.remove(runs[0])
            left = ["run 2: image"]
        case "rename":
            panel.table.item(1, 0).setText("sharp")
            left = ["sharp: image", "run 2: image"]
        case "add":
            panel.add(kept_run(viewer, [viewer.layers["burst"]], "TYX", runs[0].result, "run 3"))
            left = [*left, "run 3: image"]
        case "switch":
            runs[1].layers.switch("path", True)
            left = [*left, "run 2: path"]
        case "delete image":
            viewer.layers.remove("run 1: image")
            left = ["run 2: image"]
        case "delete shown":
            viewer.layers.remove("A, run 2")
        case "delete all":
            viewer.layers.clear()
            left = []
    qtbot.waitUntil(lambda: not panel.compare.button.isChecked())
    assert shown(viewer) == left
    assert [layer.name for layer in viewer.layers if layer.name != "burst"] == left
    assert not viewer.canvas.grid.enabled


@pytest.mark.parametrize("way", ["flicker", "side by side"])
@pytest.mark.parametrize("first", ["flicker", "side by side"])
def test_of_two_docks_that_compare_the_later_one_takes_over(grey, qtbot, kept_run, grey_result, first, way):
    viewer, panel, _ = grey
    other = RunsPanel(viewer)
    qtbot.addWidget(other)
    result = replace(grey_result, image=ramp(FIELD), canvas=FIELD)
    other.add(kept_run(viewer, [viewer.layers["burst"]], "TYX", result, "run 3"))
    viewer.layers["run 1: image"].visible = False
    before, zoom = shown(viewer), viewer.scene.camera.zoom
    press(viewer, panel, first, "run 1")
    press(viewer, other, way, "as recorded")
    qtbot.wait(50)  # what ends late would end now
    assert not panel.compare.button.isChecked()
    assert panel.compare.flip.isHidden()
    assert other.compare.button.isChecked()
    assert {name[:1] for name in shown(viewer)} <= {"A", "B"}
    assert viewer.canvas.grid.enabled == (way == "side by side")
    other.compare.stop()
    panel.compare.stop()
    assert shown(viewer) == before
    assert viewer.scene.camera.zoom == zoom
    assert not viewer.canvas.grid.enabled
    assert len(viewer.layers) == 4


def test_a_run_that_goes_on_does_not_end_it(grey):
    viewer, panel, _ = grey
    press(viewer, panel, "flicker", "run 1")
    panel.set_running(True)
    panel.refresh()
    assert shown(viewer) == ["A, run 2"]


def test_contrast_that_was_set_by_hand_is_kept(grey):
    viewer, panel, _ = grey
    viewer.layers["run 2: image"].contrast_limits = (110, 120)
    viewer.layers["run 2: image"].gamma = 0.5
    (layer,) = press(viewer, panel, "curtain", "run 1")
    assert tuple(layer.contrast_limits) == (110, 120)
    assert layer.gamma == 0.5


def test_nobody_takes_a_temporary_layer_for_a_burst_and_it_goes_with_the_dock(open_dock, kept_run, grey_frames, fit):
    viewer, dock = open_dock(Image(grey_frames, name="burst"))
    run = kept_run(viewer, [viewer.layers["burst"]], "TYX", fit(grey_frames, iterations=1))
    dock.picture.runs.add(run)
    press(viewer, dock.picture.runs, "difference", "as recorded")
    dock.reset_choices()
    assert [layer.name for layer in dock.input.burst.choices] == ["burst"]
    viewer.window.remove_dock_widget(dock.parent())
    assert shown(viewer) == ["burst", "run 1: image"]
    assert len(viewer.layers) == 2
