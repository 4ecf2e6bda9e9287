"""The runs that are kept: how they are told apart, several at once, and removing what was not meant to go."""

import gc
import re
import weakref
from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Image
from pyqtgraph import PlotWidget
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QLabel

from napari_fiberburst.plugin.display import Display
from napari_fiberburst.plugin.job import CurvePoint


@pytest.fixture
def burst(viewer, tiny_simulation):
    """Return a layer of grey frames."""
    return viewer.add_layer(Image(tiny_simulation.arrays()["frames"][..., 1], name="burst"))


@pytest.fixture
def runs(viewer, panel, kept_run, burst, grey_result):
    """Return three runs, the newest last."""
    kept = [kept_run(viewer, [burst], "TYX", grey_result, f"run {number}") for number in (1, 2, 3)]
    for run in kept:
        panel.add(run)
    return kept


def click(panel, qtbot, row, modifier=Qt.KeyboardModifier.NoModifier):
    """Click on the name in a row, as a user does."""
    table = panel.table
    place = table.visualItemRect(table.item(row, 0)).center()
    qtbot.mouseClick(table.viewport(), Qt.MouseButton.LeftButton, modifier, place)


def names(viewer):
    return [layer.name for layer in viewer.layers]


def test_each_run_shows_a_thumbnail_of_its_image(viewer, panel, kept_run, burst, grey_result):
    image = np.zeros((31, 37), np.float32)
    image[:, 18:] = 100
    image[:10, :10] = np.nan
    run = kept_run(viewer, [burst], "TYX", replace(grey_result, image=image))
    result, run.result = run.result, None
    panel.add(run)
    assert panel.table.item(0, 0).icon().isNull()  # there is no image yet
    run.result = result
    panel.refresh()
    size = panel.table.iconSize()
    shown = panel.table.item(0, 0).icon().pixmap(size).toImage()
    assert shown.width() / shown.height() == pytest.approx(37 / 31, rel=0.1)
    across, down = shown.width() - 1, shown.height() - 1
    assert shown.pixelColor(across // 4, down).value() == 0
    assert shown.pixelColor(across, down).value() == 255
    assert shown.pixelColor(0, 0).alpha() == 0  # nothing is known there
    assert panel.table.rowHeight(0) >= shown.height()


def lines_of_loss(display):
    """Return what is drawn of loss: colour and values of each line, in the order of the runs."""
    (plot,) = [plot for plot in display.curve_box.findChildren(PlotWidget) if plot.getAxis("left").labelText == "loss"]
    solid = [line for line in plot.listDataItems() if line.opts["symbol"] is None]
    return [(line.opts["pen"].color().name(), line.getOriginalDataset()[1]) for line in solid]


def legend_of(display):
    """Return the colours of the runs by their names, as the words above the plots have them."""
    words = [label.text() for label in display.curve_box.findChildren(QLabel) if "■" in label.text()]
    found = re.findall(r'color: (#\w+)">■</span>&nbsp;(.*?)(?= &nbsp; |<br>)', words[0])
    return {name: colour for colour, name in found}


def points(slope):
    return [
        CurvePoint(seconds=number, loss=slope / (1 + number), held_out_rmse=None, scores=None) for number in range(4)
    ]


def test_curves_of_several_runs_are_told_apart_and_the_card_stays_with_the_current_one(viewer, panel, runs, qtbot):
    display = Display(viewer, panel)
    for widget in (display.card, display.curve_box):
        qtbot.addWidget(widget)
    panel.chosen.connect(display.select)
    panel.charted.connect(display.chart)
    display.curve_box.expand(animate=False)
    for slope, run in enumerate(runs, 1):
        run.curve = points(slope)
    click(panel, qtbot, 0)
    click(panel, qtbot, 2)
    ((_, values),) = lines_of_loss(display)
    np.testing.assert_allclose(values, 1 / np.arange(1, 5))
    click(panel, qtbot, 1, Qt.KeyboardModifier.ControlModifier)
    drawn = dict(lines_of_loss(display))
    assert list(legend_of(display)) == ["run 2", "run 1"]
    for name, slope in (("run 1", 1), ("run 2", 2)):
        np.testing.assert_allclose(drawn[legend_of(display)[name]], slope / np.arange(1, 5))
    assert panel.run is runs[1]
    assert display.card.words.text() == " ".join(runs[1].summary)
    runs[0].curve = [*runs[0].curve, CurvePoint(seconds=4, loss=0.1, held_out_rmse=None, scores=None)]
    display._draw_curves()
    assert len(dict(lines_of_loss(display))[legend_of(display)["run 1"]]) == 5
    panel.table.item(2, 0).setText("A & B")
    assert list(legend_of(display)) == ["run 2", "A &amp; B"]
    click(panel, qtbot, 0)
    ((_, values),) = lines_of_loss(display)
    np.testing.assert_allclose(values, 3 / np.arange(1, 5))


def test_a_removed_run_comes_back_as_it_was(viewer, panel, runs):
    layer = viewer.layers["run 2: image"]
    layer.contrast_limits, layer.gamma, layer.visible, layer.name = (10, 20), 0.5, False, "mine"
    runs[1].layers.switch("path", True)
    before = names(viewer)
    assert not panel.undo_button.isVisibleTo(panel)
    panel.select(runs[1])
    panel.remove_button.click()
    assert names(viewer) == ["burst", "run 1: image", "run 3: image"]
    assert panel.runs == (runs[0], runs[2])
    assert panel.undo_button.isVisibleTo(panel)
    panel.undo_button.click()
    assert names(viewer) == before
    assert viewer.layers["mine"] is layer
    assert (tuple(layer.contrast_limits), layer.gamma, layer.visible) == ((10, 20), 0.5, False)
    assert panel.runs == tuple(runs)
    assert [panel.table.item(row, 0).text() for row in range(3)] == ["run 3", "run 2", "run 1"]
    assert panel.run is runs[1]
    assert not panel.undo_button.isVisibleTo(panel)
    # It is a run like any other again.
    assert runs[1].layers.is_on("path")
    runs[1].layers.switch("path", False)
    assert names(viewer) == ["burst", "run 1: image", "mine", "run 3: image"]


def test_several_are_removed_and_brought_back_at_once(viewer, panel, runs, qtbot):
    before = names(viewer)
    click(panel, qtbot, 0)
    click(panel, qtbot, 2, Qt.KeyboardModifier.ControlModifier)
    panel.remove_button.click()
    assert names(viewer) == ["burst", "run 2: image"]
    assert panel.run is runs[1]
    assert panel.table.selected == [runs[1]]
    panel.undo_button.click()
    assert names(viewer) == before
    assert panel.runs == tuple(runs)


def test_the_last_run_comes_back_too(viewer, panel, runs):
    seen = []
    panel.chosen.connect(seen.append)
    panel.remove(*runs)
    assert panel.run is None
    assert not panel.remove_button.isEnabled()
    panel.undo_button.click()
    assert panel.run in runs
    assert seen[-1] is panel.run
    assert panel.compare.button.isEnabled()


def test_what_was_deleted_before_stays_deleted(viewer, panel, runs):
    viewer.layers.remove("run 2: image")
    panel.remove(runs[1])
    panel.undo_button.click()
    assert names(viewer) == ["burst", "run 1: image", "run 3: image"]
    assert panel.runs == tuple(runs)


def test_only_the_last_removal_can_be_undone_and_none_once_a_run_starts(
    viewer, panel, runs, kept_run, burst, grey_result
):
    panel.remove(runs[0])
    gone = weakref.ref(runs[0])
    runs[0] = None
    panel.remove(runs[1])
    gc.collect()
    assert gone() is None
    gone = weakref.ref(runs[1])
    runs[1] = None
    panel.add(kept_run(viewer, [burst], "TYX", grey_result, "run 4"))
    gc.collect()
    assert gone() is None
    assert not panel.undo_button.isVisibleTo(panel)
    assert names(viewer) == ["burst", "run 3: image", "run 4: image"]


def test_the_run_that_is_going_cannot_be_removed(viewer, panel, runs, qtbot):
    runs[2].result = None
    panel.set_running(True)
    panel.select(runs[2])
    assert not panel.remove_button.isEnabled()
    click(panel, qtbot, 2)
    assert panel.remove_button.isEnabled()
    click(panel, qtbot, 0, Qt.KeyboardModifier.ControlModifier)
    assert not panel.remove_button.isEnabled()
