"""The result card turns the scene of a run: smoother, or without some frames; all that is told of the run follows."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from napari.layers import Image
from qtpy.QtCore import Qt

MILLISECONDS = 60_000


@pytest.fixture
def ran(open_dock, run_through, grey_frames):
    """Return a viewer, a dock and a run that has ended."""
    viewer, dock = open_dock(Image(grey_frames, name="burst"))
    dock.picture.form.set_choices({"motion": "translation", "iterations": 1})
    run = run_through(dock)
    run.layers.switch("outlines", True)
    dock.picture.display.card.refresh()
    return viewer, dock, run


def judged(qtbot, run):
    """Wait until what is shown is the run's result, and return it."""
    qtbot.waitUntil(lambda: run.result is not None, timeout=MILLISECONDS)
    return run.result


def shown(viewer, kind="image"):
    return viewer.layers[f"run 1: {kind}"].data


def click_on_outline(viewer, modifiers=("Control",)):
    """Press the mouse in the middle of the outline that is shown."""
    layer = viewer.layers["run 1: outlines"]
    frame = viewer.dims.current_step[0]
    middle = next(vertices for vertices in layer.data if vertices[0, 0] == frame).mean(axis=0)
    event = SimpleNamespace(
        position=tuple(middle),
        view_direction=None,
        dims_displayed=[1, 2],
        button=1,
        modifiers=modifiers,
    )
    for callback in list(viewer.mouse_drag_callbacks):
        callback(viewer, event)


def distance_to(corners, points):
    """Return how far points (N, 2) lie from the outline of a polygon."""
    starts, ways = corners, np.roll(corners, -1, axis=0) - corners
    along = np.clip(((points[:, None] - starts) * ways).sum(-1) / (ways**2).sum(-1), 0, 1)
    return np.linalg.norm(points[:, None] - starts - along[..., None] * ways, axis=-1).min(axis=1)


def test_the_picture_follows_the_slider_and_is_judged_at_rest(ran, qtbot):
    viewer, dock, run = ran
    box, before, first = dock.picture.display.card.steering, shown(viewer).copy(), run.result
    box.slider.setValue(box.slider.value() + 30)
    assert run.result is None, "what was judged is not what is shown"
    assert not dock.picture.runs.save.result.isEnabled()
    qtbot.waitUntil(lambda: not np.array_equal(shown(viewer), before, equal_nan=True), timeout=MILLISECONDS)
    assert np.nanstd(np.diff(shown(viewer))) < np.nanstd(np.diff(before))
    result = judged(qtbot, run)
    assert result.settings.value_of("smoothness") == float(box.value.text())
    np.testing.assert_array_equal(shown(viewer), result.image)
    assert viewer.layers["run 1: image"].metadata["fiberburst"]["reconstruction"] is result
    assert dock.picture.runs.table.item(0, 4).data(Qt.ItemDataRole.DisplayRole) == float(f"{result.held_out_rmse:.3g}")
    assert f"smoothness={result.requested.value_of('smoothness')!r}" in run.python
    assert dock.picture.runs.save.result.isEnabled()
    box.back_button.click()
    assert run.result is first
    np.testing.assert_array_equal(shown(viewer), before)
    assert "smoothness" not in run.python
    assert not box.back_button.isEnabled()


def test_the_newest_turn_wins(ran, qtbot, monkeypatch):
    _, dock, run = ran
    box, solver = dock.picture.display.card.steering, run.result.solver
    look, asked, go_on = solver.look(), [], threading.Event()

    class Slow:
        def image(self, **choices):
            asked.append(choices["smoothness"])
            go_on.wait(MILLISECONDS / 1000)
            return look.image(**choices)

    monkeypatch.setattr(type(solver), "look", lambda _: Slow())
    for step in (-10, -5, 0, 5, 10):
        box.slider.setValue(step)
    go_on.set()
    result = judged(qtbot, run)
    assert asked == [0.32, 3.2]
    assert result.settings.value_of("smoothness") == asked[-1]


def test_what_rests_on_the_old_result_is_gone_until_there_is_a_new_one(ran, qtbot):
    viewer, dock, run = ran
    card = dock.picture.display.card
    card.switches["uncertainty"].click()
    before = shown(viewer, "uncertainty").copy()
    card.steering.slider.setValue(card.steering.slider.value() + 20)
    assert "run 1: uncertainty" not in viewer.layers
    assert not card.switches["uncertainty"].isEnabled()
    assert "judged anew" in card.words.text()
    assert not card.notes.text()
    assert card.report.isHidden()
    result = judged(qtbot, run)
    np.testing.assert_array_equal(shown(viewer, "uncertainty"), result.uncertainty)
    assert not np.array_equal(before, result.uncertainty)
    assert card.switches["uncertainty"].isChecked()
    assert "finest detail" in card.words.text()


def test_a_click_on_an_outline_leaves_its_frame_out_and_brings_it_back(ran, qtbot):
    viewer, dock, run = ran
    box, layer = dock.picture.display.card.steering, viewer.layers["run 1: outlines"]
    usual = layer.edge_color[0].copy()
    viewer.dims.set_current_step(0, 5)
    click_on_outline(viewer, modifiers=())
    assert run.result is not None, "a plain click moves the view"
    click_on_outline(viewer)
    assert box.frames.text() == "5"
    assert layer.edge_color[5][3] == 0, "of a frame left out only dashes are seen"
    lines = [np.asarray(ends) for ends, kind in zip(layer.data, layer.shape_type, strict=True) if kind == "line"]
    assert {tuple(ends[:, 0]) for ends in lines} == {(5.0, 5.0)}
    corners = layer.data[5][:, 1:]
    around = sum(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1))
    dashed = sum(np.linalg.norm(np.diff(ends[:, 1:], axis=0)) for ends in lines)
    assert dashed == pytest.approx(around / 2, rel=1e-3)
    for ends in lines:
        np.testing.assert_allclose(distance_to(corners, ends[:, 1:]), 0, atol=1e-3)
    np.testing.assert_array_equal(layer.edge_color[4], usual)
    result = judged(qtbot, run)
    assert 5 not in result.frames_used
    assert result.requested.value_of("leave_out") == (5,)
    assert "left out by hand: frame 5" in dock.picture.display.card.notes.text()
    assert "leave_out=(5,)" in run.python
    click_on_outline(viewer)
    assert judged(qtbot, run).frames_used == tuple(range(8))
    np.testing.assert_array_equal(layer.edge_color[5], usual)
    assert set(layer.shape_type) == {"polygon"}


def test_outlines_are_not_clicked_while_somebody_draws(ran):
    viewer, _, run = ran
    drawing = viewer.add_shapes()
    drawing.mode = "add_rectangle"
    click_on_outline(viewer)
    assert run.result is not None


def test_frames_are_left_out_by_keyboard(ran, qtbot):
    viewer, dock, run = ran
    box = dock.picture.display.card.steering
    viewer.dims.set_current_step(0, 2)
    assert box.frame_button.text() == "Leave out frame 2"
    qtbot.keyClick(box.frame_button, Qt.Key.Key_Space)
    assert box.frame_button.text() == "Take in frame 2"
    box.frames.clear()
    qtbot.keyClicks(box.frames, "6 2, 6 99 x")
    qtbot.keyClick(box.frames, Qt.Key.Key_Return)
    assert box.frames.text() == "2, 6"
    assert judged(qtbot, run).frames_used == (0, 1, 3, 4, 5, 7)
    box.frames.clear()
    qtbot.keyClicks(box.frames, "0 1 2 3 4 5 6 7")
    qtbot.keyClick(box.frames, Qt.Key.Key_Return)
    assert box.frames.text() == "2, 6", "some frame has to stay"


def test_turning_ends_with_the_run_and_without_the_dock(ran, qtbot):
    viewer, dock, run = ran
    box = dock.picture.display.card.steering
    box.slider.setValue(box.slider.value() + 10)
    dock.picture.runs.remove(run)
    assert box.isHidden()
    dock.shut_down()
    before = len(viewer.layers)
    qtbot.waitUntil(lambda: not box.is_pending)
    assert len(viewer.layers) == before


def test_a_failure_goes_back_to_what_was_judged(ran, qtbot, monkeypatch):
    viewer, dock, run = ran
    first, told = run.result, []
    monkeypatch.setattr("napari_fiberburst.plugin.turning.show_error", told.append)

    def fail(*_, **__):
        raise MemoryError("no room")

    monkeypatch.setattr(type(first.solver), "solve", fail)
    dock.picture.display.card.steering.slider.setValue(0)
    assert judged(qtbot, run) is first
    assert "no room" in told[0]
    np.testing.assert_array_equal(shown(viewer), first.image)


def test_scores_against_the_truth_are_of_what_is_shown(open_dock, run_through, burst_layer, qtbot):
    _, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({"motion": "translation", "iterations": 1})
    run = run_through(dock)
    before = run.scores.psnr
    dock.picture.display.card.steering.slider.setValue(dock.picture.display.card.steering.slider.maximum())
    judged(qtbot, run)
    assert run.scores.psnr < before - 1


def test_a_network_has_nothing_to_turn(open_dock, run_through, grey_frames):
    _, dock = open_dock(Image(grey_frames, name="burst"))
    quick = {"preset": "paper", "iterations": 2, "scene_width": 16, "scene_layers": 1, "features": 16, "batch": 64}
    dock.picture.form.set_choices(quick)
    run_through(dock)
    assert dock.picture.display.card.steering.isHidden()
