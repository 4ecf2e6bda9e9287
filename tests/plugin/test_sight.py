"""What a user sees of the dock at 1280 x 800: the way from the burst to what came of it, with nothing cut off."""

from dataclasses import replace

import pytest
from napari.layers import Image
from qtpy.QtWidgets import QAbstractButton, QLabel

MILLISECONDS = 60_000
QUICK = {"motion": "translation", "iterations": 1}
# As long as those that runs have.
NOTES = (
    "frames moved by 8.0 px while they were exposed: detail along the motion is lost; a shorter exposure shows it",
    "3 of 20 frames could not be registered, and take no part",
)


@pytest.fixture(params=["dark", "light"])
def window(request, open_dock, qtbot):
    """Return a function that opens a drawn window of 1280 x 800 with these layers, in either theme."""

    def opened(*layers):
        viewer, dock = open_dock(*layers)
        viewer.theme = request.param
        viewer.window._qt_window.show()
        viewer.window.resize(1280, 800)
        qtbot.waitUntil(lambda: dock.isVisible() and viewer.window._qt_window.height() == 800)
        return viewer, dock

    return opened


@pytest.fixture
def burst(grey_frames):
    return Image(grey_frames, name="burst")


def cut_off(dock):
    """Return the words of labels and buttons that are in the dock and have less room than their text takes."""
    found = []
    for widget in (*dock.findChildren(QLabel), *dock.findChildren(QAbstractButton)):
        if not widget.isVisible() or not widget.text() or widget.size().isEmpty():
            continue
        if isinstance(widget, QLabel) and widget.wordWrap():
            is_cut = widget.height() < widget.heightForWidth(widget.width())
        else:
            is_cut = widget.width() < widget.minimumSizeHint().width()
        if is_cut:
            found.append(widget.text())
    return found


def hidden_of(*widgets):
    """Return those that are not, or not wholly, to be seen without scrolling."""
    return [
        widget for widget in widgets if not widget.isVisible() or widget.visibleRegion().boundingRect() != widget.rect()
    ]


def assert_seen(qtbot, dock, *widgets):
    qtbot.waitUntil(lambda: not hidden_of(*widgets))
    qtbot.waitUntil(lambda: not cut_off(dock))


def way(dock):
    """Return what a user goes through from the burst to what came of it."""
    picture = dock.picture
    card, save = picture.display.card, picture.runs.save
    return (
        dock.input.burst.native,
        picture.start_button,
        card.words,
        card.report.button,
        picture.runs.table,
        save.result,
    )


def test_the_empty_dock_and_one_with_a_burst_are_seen_whole(window, burst, qtbot):
    viewer, dock = window()
    assert_seen(qtbot, dock, *dock.empty.findChildren(QAbstractButton))
    viewer.add_layer(burst)
    qtbot.waitUntil(lambda: "moves by" in dock.glance.words.text(), timeout=MILLISECONDS)
    assert_seen(qtbot, dock, dock.input.burst.native, dock.glance.strip, dock.glance.words, dock.picture.start_button)


def test_a_result_a_doubtful_one_and_a_comparison_are_seen_whole(window, burst, run_through, qtbot):
    _, dock = window(burst)
    picture = dock.picture
    picture.form.set_choices(QUICK)
    width = dock.width()
    run_through(dock)
    assert_seen(qtbot, dock, *way(dock), picture.runs.compare)
    assert dock.width() == width
    run = run_through(dock)
    run.result = replace(run.result, quality="doubtful", notes=NOTES)
    picture.display.card.refresh()
    picture.runs.refresh()
    assert "doubtful" in picture.display.card.words.text()
    assert_seen(qtbot, dock, *way(dock), picture.display.card.notes)
    compare = picture.runs.compare
    run.result = replace(run.result, quality="good", notes=())
    picture.display.card.refresh()
    compare.way.setCurrentText("curtain")
    compare.button.click()
    assert_seen(qtbot, dock, compare.button, compare.line, compare.words)


def test_why_a_run_failed_is_seen_whole(window, burst, qtbot):
    _, dock = window(burst)
    picture = dock.picture
    picture.form.set_choices(QUICK)
    picture.display.fail(
        "run 1",
        "the bundle has no cores that could be told apart in these frames; take an image of the bundle in even light",
    )
    assert_seen(qtbot, dock, picture.start_button, picture.display.status, picture.departures)
