"""Keys and napari's command palette do what the dock's buttons do."""

import pytest
from napari.components import ViewerModel
from napari.settings import get_settings
from napari.utils.action_manager import action_manager
from napari.utils.key_bindings import coerce_keybinding
from napari.utils.notifications import notification_manager
from npe2 import PluginManifest
from qtpy.QtCore import QEvent, QPoint, Qt
from qtpy.QtGui import QHelpEvent
from qtpy.QtWidgets import QApplication, QFileDialog, QPushButton, QToolTip
from skimage.io import imread
from superqt import QCollapsible

from napari_fiberburst.plugin import commands
from napari_fiberburst.plugin.tasks.bundle import BundleTask
from napari_fiberburst.plugin.tasks.live import LiveTask

MILLISECONDS = 60_000


def hint(widget):
    """Return the tooltip that a pointer over a widget brings up."""
    widget.window().show()
    QApplication.sendEvent(widget, QHelpEvent(QEvent.Type.ToolTip, QPoint(1, 1), widget.mapToGlobal(QPoint(1, 1))))
    return QToolTip.text()


def test_a_key_starts_starts_a_run(open_dock, burst_layer, qtbot):
    _, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({"motion": "translation", "iterations": 1})
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        qtbot.keyClick(dock.picture.start_button, Qt.Key.Key_Return, Qt.KeyboardModifier.ControlModifier)
    assert [run.name for run in dock.picture.runs.runs] == ["run 1"]


def test_commands_of_the_palette_act_on_the_dock_that_is_open(open_dock, burst_layer, qtbot, run_through):
    _, dock = open_dock(burst_layer)
    first, second = run_through(dock), run_through(dock)
    commands.next_run()
    assert dock.picture.runs.run is first
    commands.next_run()
    assert dock.picture.runs.run is first
    commands.previous_run()
    assert dock.picture.runs.run is second
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        commands.start()
        commands.pause()
        assert dock.picture.runner.state == "paused"
        commands.pause()
    assert len(dock.picture.runs.runs) == 3


def test_start_belongs_to_the_task_that_is_shown(open_dock, burst_layer, qtbot):
    _, dock = open_dock(burst_layer)
    dock.choose_task(BundleTask)
    commands.start()
    qtbot.waitUntil(lambda: dock.input.bundle.value is not None, timeout=MILLISECONDS)
    assert dock.picture.runner.state == "ready"


def test_what_cannot_be_done_now_is_said(open_dock, burst_layer):
    _, dock = open_dock(burst_layer)
    commands.stop()
    assert (
        notification_manager.records[-1].message
        == f"Stop the run and keep it: not now. {dock.picture.stop_button.toolTip()}"
    )


def test_the_figure_is_saved_by_its_command_once_there_is_an_image(
    open_dock, burst_layer, run_through, qtbot, monkeypatch, tmp_path
):
    path = tmp_path / "figure.png"
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(path), ""))
    _, dock = open_dock(burst_layer)
    for name in ("figure", "report"):
        commands.press(name)
        assert "not now" in notification_manager.records[-1].message
    run_through(dock)
    commands.figure()
    box = dock.picture.display.card.report
    qtbot.waitUntil(lambda: "figure of run 1 is in" in box.words.text(), timeout=MILLISECONDS)
    assert imread(path).shape[1] > imread(path).shape[0]


def test_start_opens_the_dock_and_the_others_say_that_it_is_closed(make_napari_viewer, npe2pm):
    npe2pm.register(PluginManifest.from_distribution("napari-fiberburst"))
    viewer = make_napari_viewer()
    commands.pause()
    assert "the dock is not open" in notification_manager.records[-1].message
    assert not viewer.window.dock_widgets
    commands.start()
    assert len(viewer.window.dock_widgets) == 1


def test_every_command_is_in_the_palette_and_among_the_keys_that_napari_can_change(open_dock):
    manifest = PluginManifest.from_distribution("napari-fiberburst")
    inside = "napari_fiberburst.plugin.commands:"
    offered = {
        command.id: command.title
        for command in manifest.contributions.commands
        if command.python_name.startswith(inside) and callable(getattr(commands, command.python_name[len(inside) :]))
    }
    open_dock()
    titles = {name: command.title for name, command in commands.COMMANDS.items()} | {"film": commands.FILM_TITLE}
    assert offered == {f"napari-fiberburst.{name}": title for name, title in titles.items()}
    for name, title in titles.items():
        action = action_manager._actions[f"napari-fiberburst:{name}"]
        assert (action.description, action.keymapprovider) == (title, ViewerModel)
    for command in commands.COMMANDS.values():
        if command.key is not None:
            assert coerce_keybinding(command.key) in ViewerModel.class_keymap


def test_every_button_has_a_command_but_for_those_that_fold_and_choose_a_place(open_dock):
    _, dock = open_dock()
    empty, compare = dock.empty, dock.picture.runs.compare
    # One has a menu; the space bar presses one; and two do what a command does to what is chosen elsewhere.
    others = {empty.sample_button, compare.flip, empty.open_button, dock.tasks[1].film_button}
    others |= {box.toggleButton() for box in dock.findChildren(QCollapsible)}
    commanded = set(commands.KeyHints(dock).widgets)
    without = [
        button.text()
        for button in dock.findChildren(QPushButton)
        if button.text() != "…" and button not in others | commanded
    ]
    assert not without


def test_what_there_is_nothing_for_is_said_and_does_nothing(open_dock, burst_layer):
    _, dock = open_dock(burst_layer)
    names = (
        "best_frames",
        "motion",
        "keep_bundle",
        "keep_burst",
        "leave_out",
        "as_chosen",
        "remove_runs",
        "undo_remove",
    )
    for name in (*names, "continue_run", "shown_frames"):
        commands.press(name)
        assert notification_manager.records[-1].message.startswith(f"{commands.COMMANDS[name].title}: not now.")
    assert dock.picture.is_empty


def test_runs_are_removed_and_brought_back_by_commands(open_dock, burst_layer, run_through):
    _, dock = open_dock(burst_layer)
    run = run_through(dock)
    commands.remove_runs()
    assert not dock.picture.runs.runs
    commands.undo_remove()
    assert dock.picture.runs.runs == (run,)


def test_the_live_view_opens_by_its_command_in_a_dock_that_was_closed(make_napari_viewer, npe2pm):
    npe2pm.register(PluginManifest.from_distribution("napari-fiberburst"))
    viewer = make_napari_viewer()
    commands.show_live()
    assert isinstance(commands.find_dock(viewer).task, LiveTask)


@pytest.mark.parametrize(("chosen", "told"), [(None, "Ctrl+↵"), (["Alt-Q"], "Alt+Q")])
def test_tooltips_tell_the_key_that_is_in_force(open_dock, burst_layer, monkeypatch, chosen, told):
    shortcuts = get_settings().shortcuts.shortcuts
    if chosen is not None:
        monkeypatch.setitem(shortcuts, "napari-fiberburst:start", chosen)
    _, dock = open_dock(burst_layer)
    assert hint(dock.picture.start_button) == f"Reconstruct the burst; everything sets itself. ({told})"
    action_manager.unbind_shortcut("napari-fiberburst:start")
