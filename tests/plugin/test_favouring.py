"""A rectangle that is drawn while a network learns is learned first."""

import pytest
from napari.layers import Image

MILLISECONDS = 60_000
LONG = {
    "preset": "paper",
    "encoding": "fourier",
    "iterations": 10**6,
    "scene_width": 16,
    "scene_layers": 1,
    "features": 16,
    "batch": 64,
}


@pytest.fixture
def going(open_dock, grey_frames, qtbot):
    """Return a function that starts a run of a layer whose pixels are 2 by 1, and returns viewer, dock and job."""
    docks = []

    def started(choices):
        viewer, dock = open_dock(Image(grey_frames, scale=(1, 2, 1), name="burst"))
        docks.append(dock)
        dock.picture.form.set_choices(choices)
        dock.picture.start()
        qtbot.waitUntil(lambda: bool(dock.picture.runner.job.curve), timeout=MILLISECONDS)
        return viewer, dock, dock.picture.runner.job

    yield started
    for dock in docks:
        with qtbot.waitSignal(dock.picture.runner.ready, timeout=MILLISECONDS):
            dock.picture.stop_button.click()


def test_a_rectangle_drawn_while_a_network_learns_is_learned_first(going):
    viewer, dock, job = going(LONG)
    drawn = viewer.add_shapes(name="here")
    drawn.add_rectangles([[20, 10], [60, 40]])  # in world units, rows first
    assert job.control.region == (10.0, 10.0, 41.0, 31.0)
    assert "learned first" in dock.picture.display.status.text()
    assert dock.picture.runs.run.turned_live[-1][1:] == ("region", (10.0, 10.0, 41.0, 31.0))
    drawn.selected_data = {0}
    drawn.remove_selected()
    assert job.control.region is None


def test_what_was_drawn_before_does_not_count(going):
    _, dock, job = going(LONG)
    dock.picture.runs.run.layers.switch("outlines", True)
    assert job.control.region is None, "outlines are shapes, and not the user's"
