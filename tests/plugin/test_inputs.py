"""What may be a burst in the dock, where its results then lie, and what is refused."""

import dask.array as da
import numpy as np
import pytest
from napari.layers import Image, Labels, Shapes
from napari.utils.notifications import notification_manager
from npe2 import PluginManifest

from napari_fiberburst import read_burst
from napari_fiberburst.plugin.saving import save_result

MILLISECONDS = 60_000


@pytest.fixture
def run_quickly(run_through):
    """Return the same function for runs of few steps, because what they come to is not asserted here."""

    def ran(dock):
        dock.picture.form.set_choices({"motion": "translation", "iterations": 1})
        return run_through(dock)

    return ran


def notices_during(act):
    """Return the notifications that came while something was done."""
    before = len(notification_manager.records)
    act()
    return [record.message for record in list(notification_manager.records)[before:]]


def switch_on(dock, *kinds):
    """Show these on the result card."""
    for kind in kinds:
        dock.picture.display.card.switches[kind].setChecked(True)


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
    (notice,) = notices_during(dock.picture.start)
    assert words in notice
    assert dock.picture.runner.state == "ready"


def test_a_burst_with_nan_is_refused_in_one_notification(open_dock, qtbot, grey_frames):
    frames = grey_frames.astype(np.float32)
    frames[2, 5, 5] = np.nan
    viewer, dock = open_dock(Image(frames))
    before = len(notification_manager.records)
    with qtbot.waitSignal(dock.picture.runner.ready, timeout=MILLISECONDS):
        dock.picture.start()
    (notice,) = [record.message for record in list(notification_manager.records)[before:]]
    assert "frame 2 holds NaN" in notice
    assert len(viewer.layers) == 1
    assert not dock.picture.runs.runs


def test_a_region_limits_the_run(open_dock, run_through, burst_layer):
    corners = np.array([[5.0, 8.0], [5.0, 47.0], [40.0, 47.0], [40.0, 8.0]])
    viewer, dock = open_dock(burst_layer, Shapes([corners], shape_type="rectangle", name="look here"))
    dock.input.region.value = viewer.layers["look here"]
    run = run_through(dock)
    image = viewer.layers["run 1: image"]
    assert run.result.image.shape == (36, 40, 3)
    np.testing.assert_array_equal(image.translate, [5, 8])
    assert run.scores.motion_error < 0.7


def test_scale_units_and_labels_are_carried_over(open_dock, run_through, grey_frames):
    layer = Image(grey_frames, scale=(1, 0.5, 0.25), translate=(0, 10, 20), units=("s", "um", "um"))
    layer.axis_labels = ("t", "y", "x")
    viewer, dock = open_dock(layer)
    dock.picture.form.set_choices({"upsample": 2.0})
    run = run_through(dock)
    switch_on(dock, "stabilised burst", "outlines", "path")
    image, still = viewer.layers["run 1: image"], viewer.layers["run 1: stabilised burst"]
    assert run.result.acquisition.pixel_size == (0.5, 0.25)
    assert run.result.acquisition.unit == "µm"
    np.testing.assert_allclose(image.scale, [0.25, 0.125])
    np.testing.assert_allclose(image.translate, [10 - 0.125, 20 - 0.0625])  # pixel edges meet, not centres
    assert image.axis_labels == ("y", "x")
    assert still.axis_labels == ("t", "y", "x")
    assert [str(unit) for unit in image.units] == ["micrometer", "micrometer"]
    for own in ("outlines", "path"):
        np.testing.assert_allclose(viewer.layers[f"run 1: {own}"].scale, [1, 0.5, 0.25])


def test_what_an_ome_tiff_says_is_in_results_although_napari_opens_it(
    open_dock, run_quickly, npe2pm, ome_file, tmp_path
):
    npe2pm.register(PluginManifest.from_distribution("napari"))
    viewer, dock = open_dock()
    (layer,) = viewer.open(str(ome_file), plugin="napari")
    np.testing.assert_array_equal(layer.scale, [1, 1, 0.5, 0.25])
    run = run_quickly(dock)
    known = run.result.acquisition
    assert (known.pixel_size, known.unit) == ((0.5, 0.25), "µm")
    assert known.channel_names == ("red", "green")
    np.testing.assert_allclose(known.times, 0.2 * np.arange(8))
    image = viewer.layers["run 1: image"]
    np.testing.assert_array_equal(image.scale[-2:], [0.5, 0.25])
    assert [str(unit) for unit in image.units[-2:]] == ["micrometer", "micrometer"]
    save_result(run, tmp_path / "out.ome.tif")
    written = read_burst(tmp_path / "out.ome.tif", axes="CYX")
    assert (written.pixel_size, written.unit) == ((0.5, 0.25), "µm")
    assert written.channel_names == ("red", "green")


def test_a_file_moves_no_layer_apart_from_those_that_lie_over_it(open_dock, npe2pm, ome_file):
    npe2pm.register(PluginManifest.from_distribution("napari"))
    viewer, dock = open_dock(Shapes([np.array([[5.0, 8.0], [5.0, 47.0], [40.0, 47.0], [40.0, 8.0]])]))
    (layer,) = viewer.open(str(ome_file), plugin="napari")
    np.testing.assert_array_equal(layer.scale, 1)
    assert dock.input.source().read().pixel_size == (0.5, 0.25)


def test_what_a_file_says_of_other_frames_is_left_out(open_dock, npe2pm, ome_file):
    npe2pm.register(PluginManifest.from_distribution("napari"))
    viewer, dock = open_dock()
    (layer,) = viewer.open(str(ome_file), plugin="napari")
    layer.data = layer.data[2:, :1]
    burst = dock.input.source().read()
    assert (burst.times, burst.channel_names) == (None, ())


@pytest.mark.parametrize("order", ["TCYX", "CTYX"])
def test_channels_that_are_no_colours_stay_an_axis(open_dock, run_quickly, simulated, order):
    frames = simulated.arrays()["frames"][..., [0, 1]]
    viewer, dock = open_dock(Image(frames.transpose(["TYXC".index(axis) for axis in order])))
    assert dock.input.axes.text() == order
    run = run_quickly(dock)
    image = viewer.layers["run 1: image"]
    expected = np.moveaxis(run.result.image, 2, 0)
    shown = image.data if order == "TCYX" else image.data[:, 3]
    np.testing.assert_array_equal(shown, expected)
    switch_on(dock, "stabilised burst")
    assert viewer.layers["run 1: stabilised burst"].data.shape == viewer.layers[0].data.shape


def test_grey_layers_make_one_burst(open_dock, run_quickly, qtbot, simulated):
    frames = simulated.arrays()["frames"]
    names = ("red", "green")
    viewer, dock = open_dock(*(Image(frames[..., number], name=name) for number, name in enumerate(names)))
    dock.input.burst.value = viewer.layers["red"]
    item = dock.input.channels.item(0)
    assert item.text() == "green"
    item.setCheckState(dock.input.channels.item(0).checkState().Checked)
    run = run_quickly(dock)
    assert run.result.image.shape == (63, 75, 2)
    assert run.result.acquisition.channel_names == names
    for number, name in enumerate(names):
        np.testing.assert_array_equal(viewer.layers[f"run 1: image of {name}"].data, run.result.image[..., number])
    switch_on(dock, "stabilised burst")
    for name in names:
        assert viewer.layers[f"run 1: stabilised burst of {name}"].data.shape == (8, 63, 75)
    dock.picture.display.card.switches["stabilised burst"].setChecked(False)
    assert not [layer for layer in viewer.layers if "stabilised" in layer.name]


def test_a_dask_layer_is_a_burst(open_dock, run_quickly, grey_frames):
    viewer, dock = open_dock(Image(da.from_array(grey_frames, chunks=(1, 63, 75))))
    assert run_quickly(dock).result.image.shape == (63, 75)
    switch_on(dock, "stabilised burst")
    still = viewer.layers["run 1: stabilised burst"].data
    assert isinstance(still, da.Array)
    np.testing.assert_array_equal(still[0].compute(), grey_frames[0])


def test_more_than_fits_is_refused_with_a_reason(open_dock, grey_frames):
    _, dock = open_dock(Image(np.broadcast_to(grey_frames[:1], (10**6, 63, 75))))
    dock.input.frames.edit.setText("0:1000000")
    (notice,) = notices_during(dock.picture.start)
    assert "GB of memory" in notice
    assert "draw a region" in notice
    assert dock.picture.runner.state == "ready"


def test_a_truth_that_fits_no_longer_is_let_go(open_dock, run_quickly, burst_layer):
    _, dock = open_dock(burst_layer)
    burst_layer.data = burst_layer.data[:5]
    run = run_quickly(dock)
    assert run.result.ending == "finished"
    assert run.scores is None


def test_axes_of_length_one_in_front_are_no_hindrance(open_dock, run_quickly, grey_frames):
    viewer, dock = open_dock(Image(grey_frames[None, None]))
    run = run_quickly(dock)
    np.testing.assert_array_equal(viewer.layers["run 1: image"].data, run.result.image)
    switch_on(dock, "path")
    assert viewer.layers["run 1: path"].data.shape == (8, 4)


@pytest.mark.parametrize("axes", ["TYXQ", "CYXT"])
def test_axes_that_cannot_be_are_refused_before_the_run(open_dock, burst_layer, axes):
    _, dock = open_dock(burst_layer)
    dock.input.axes.setText(axes)
    (notice,) = notices_during(dock.picture.start)
    assert "let them end in C" in notice
    assert dock.picture.runner.state == "ready"


def test_a_menu_command_on_something_else_says_so(open_dock, burst_layer):
    labels = Labels(np.ones((5, 20, 20), int))
    _, dock = open_dock(burst_layer, labels)
    (notice,) = notices_during(lambda: dock.start_on(labels))
    assert "is no image that could be a burst" in notice
    assert dock.picture.runner.state == "ready"
