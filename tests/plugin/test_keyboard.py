"""The dock by keyboard: every control has a name, and the tab key goes through them from top to bottom."""

from itertools import islice

import pytest
from qtpy import QtWidgets
from qtpy.QtCore import QPoint, Qt
from superqt import QCollapsible

KINDS = "AbstractButton AbstractSpinBox ComboBox LineEdit ListWidget Slider TabBar TableWidget".split()
CONTROLS = tuple(getattr(QtWidgets, f"Q{kind}") for kind in KINDS)


def controls(dock):
    """Return what can have the focus, but for the inside of spin boxes and combo boxes."""
    found = [widget for kind in CONTROLS for widget in dock.findChildren(kind)]
    return [
        widget
        for widget in found
        if widget.focusPolicy() & Qt.FocusPolicy.TabFocus
        and not isinstance(widget.parent(), (QtWidgets.QAbstractSpinBox, QtWidgets.QComboBox))
    ]


def test_every_control_has_a_name(open_dock, burst_layer):
    _, dock = open_dock(burst_layer)
    found = controls(dock)
    assert len(found) > 60
    for widget in found:
        name = widget.accessibleName() or (widget.text() if isinstance(widget, QtWidgets.QAbstractButton) else "")
        assert name, f"{widget} in {widget.parent()} has no name, {widget.toolTip()!r}"


@pytest.mark.parametrize("is_open", [False, True])
def test_the_tab_key_goes_from_top_to_bottom(open_dock, run_through, burst_layer, qtbot, is_open):
    viewer, dock = open_dock(burst_layer)
    viewer.window.resize(1280, 800)
    dock.window().show()
    run_through(dock)
    for section in dock.findChildren(QCollapsible) if is_open else ():
        section.expand(animate=False)
    form = dock.picture.form
    assert form.isVisible() == is_open, "what is folded away is not reached"
    qtbot.waitUntil(lambda: not is_open or form.height() >= form.sizeHint().height())
    stops, widget = [], dock.task_bar
    while True:
        stops.append(widget)
        widget = widget.nextInFocusChain()
        while not (widget.isVisible() and widget.focusPolicy() & Qt.FocusPolicy.TabFocus and widget.isEnabled()):
            widget = widget.nextInFocusChain()
        if widget is dock.task_bar or not dock.isAncestorOf(widget):
            break
    asked = {widget for widget in controls(dock) if widget.isVisible() and widget.isEnabled()}
    assert asked <= set(stops)
    tops = [stop.mapTo(dock, QPoint(0, stop.height() // 2)).y() for stop in stops if stop in asked]
    for before, after in zip(tops, islice(tops, 1, None), strict=False):
        assert after >= before - 6, "the tab key goes up"
