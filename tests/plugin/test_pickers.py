"""Layers are picked by magicgui's combo boxes, and the wheel scrolls the dock."""

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image
from pyqtgraph import PlotWidget
from qtpy.QtCore import QPoint, QPointF, Qt
from qtpy.QtGui import QWheelEvent
from qtpy.QtWidgets import QApplication, QScrollArea, QSlider, QWidget

from napari_fiberburst.plugin.pickers import LayerPicker


@pytest.fixture
def viewer():
    return ViewerModel()


@pytest.fixture
def layers(viewer):
    return [viewer.add_layer(Image(np.zeros((5, 31, 37)), name=name)) for name in ("first", "second", "third")]


def texts(picker):
    return [picker.native.itemText(row) for row in range(picker.native.count())]


def test_a_choice_stays_when_its_layer_is_renamed_or_moved(qtbot, viewer, layers):
    picker = LayerPicker(viewer, lambda layer: True)
    picker.value = layers[1]
    changes = []
    picker.changed.connect(changes.append)
    layers[1].name = "renamed"
    viewer.layers.move(0, 3)
    picker.reset_choices()
    assert picker.value is layers[1]
    assert texts(picker) == ["renamed", "third", "first"]
    assert changes == []


def test_a_choice_that_is_removed_goes_to_the_first_or_to_nothing(qtbot, viewer, layers):
    needed, optional = LayerPicker(viewer, lambda layer: True), LayerPicker(viewer, lambda layer: True, "none")
    assert needed.value is layers[0]
    assert optional.value is None
    needed.value = optional.value = layers[2]
    changes = []
    needed.changed.connect(changes.append)
    optional.changed.connect(changes.append)
    viewer.layers.remove(layers[2])
    needed.reset_choices()
    optional.reset_choices()
    assert changes == [layers[0], None]
    viewer.layers.clear()
    needed.reset_choices()
    assert needed.value is None
    assert changes == [layers[0], None, None]


def test_only_layers_that_are_accepted_are_offered(qtbot, viewer, layers):
    picker = LayerPicker(viewer, lambda layer: layer.name != "second", "whole frame")
    assert texts(picker) == ["whole frame", "first", "third"]
    with pytest.raises(ValueError, match="not a valid choice"):
        picker.value = layers[1]


def test_the_dock_follows_layers_that_come_go_and_are_renamed(open_dock, burst_layer, grey_frames):
    viewer, dock = open_dock(burst_layer)
    late = viewer.add_layer(Image(grey_frames, name="late"))
    dock.input.burst.value = late
    late.name = "renamed"
    assert dock.input.burst.current_choice == "renamed"
    assert dock.input.axes.text() == "TYX"
    viewer.layers.remove(late)
    assert dock.input.burst.value is burst_layer
    assert dock.input.axes.text() == "TYXC"


def turn_wheel(widget):
    middle = QPointF(widget.rect().center())
    event = QWheelEvent(
        middle,
        QPointF(widget.mapToGlobal(widget.rect().center())),
        QPoint(0, 0),
        QPoint(0, 120),
        Qt.MouseButton.NoButton,
        Qt.KeyboardModifier.NoModifier,
        Qt.ScrollPhase.NoScrollPhase,
        False,
    )
    QApplication.sendEvent(widget, event)


def test_the_wheel_scrolls_the_dock_and_turns_nothing(open_dock, run_through, burst_layer, monkeypatch):
    viewer, dock = open_dock(burst_layer)
    run_through(dock)
    viewer.window.resize(1000, 400)
    dock.picture.display.curve_box.expand(animate=False)
    monkeypatch.setattr(QWidget, "hasFocus", lambda _: True)
    number, box = dock.picture.form.rows["upsample"].editor.native, dock.picture.form.boxes["motion"]
    plots = dock.picture.display.curve_box.findChildren(PlotWidget)
    (slider,) = dock.picture.display.slider.findChildren(QSlider)
    bar = dock.findChild(QScrollArea).verticalScrollBar()
    bar.setRange(0, 1000)
    before = number.value(), box.currentIndex(), slider.value(), [plot.viewRange() for plot in plots]
    for widget in (number, box, slider, *(plot.viewport() for plot in plots)):
        bar.setValue(500)
        turn_wheel(widget)
        assert bar.value() < 500
    assert (number.value(), box.currentIndex(), slider.value(), [plot.viewRange() for plot in plots]) == before
    assert {widget.focusPolicy() for widget in (number, box, slider)} == {Qt.FocusPolicy.StrongFocus}


def test_no_editor_widens_the_dock(open_dock, burst_layer, grey_frames):
    viewer, dock = open_dock(burst_layer, Image(grey_frames, name="a name that is longer than the dock is wide " * 3))
    dock.input.burst.value = viewer.layers[1]
    dock.picture.form.set_choices({"time_budget": 123456789.0, "seed": 2**31 - 1})
    for widget in (dock.picture.form, dock.input):
        assert widget.minimumSizeHint().width() <= dock.sizeHint().width()
