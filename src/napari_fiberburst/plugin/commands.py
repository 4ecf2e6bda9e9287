"""What the dock does by a key, or from napari's command palette.

`napari.yaml` names the functions, which puts them into the palette. `bind_keys` gives them keys among napari's own, and
its preferences change them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from napari.components import ViewerModel
from napari.settings import get_settings
from napari.utils.action_manager import action_manager
from napari.utils.interactions import Shortcut
from napari.utils.notifications import show_info
from qtpy.QtCore import QEvent, QObject
from qtpy.QtGui import QHelpEvent
from qtpy.QtWidgets import QAbstractButton, QToolTip, QWidget

from napari_fiberburst.plugin.bursts import guess_axes
from napari_fiberburst.plugin.contributions import PLUGIN
from napari_fiberburst.plugin.film import ask_and_save
from napari_fiberburst.plugin.tasks.bundle import BundleTask
from napari_fiberburst.plugin.tasks.live import LiveTask
from napari_fiberburst.plugin.tasks.long import LongTask

if TYPE_CHECKING:
    import napari

    from napari_fiberburst.plugin.dock import FiberBurstWidget

_WIDGET = "Fiber burst reconstruction"
FILM_TITLE = "Save film…"


@dataclass(frozen=True, kw_only=True)
class Command:
    """Something that the dock can be told.

    Attributes
    ----------
    title : str
        What it does.
    key : str or None
        The key that it has unless the user has chosen another one.
    widget : callable
        From the dock to the widget that does the same, whose tooltip tells the key.
    act : callable
        Does it, with that widget; presses a button by default.
    may_open : bool
        Whether the dock is opened for it, where it is closed.
    """

    title: str
    key: str | None = None
    widget: Callable[[Any], QWidget]
    act: Callable[[Any], None] = QAbstractButton.click
    may_open: bool = False


def _going(dock: Any) -> Any:
    """Return the task whose run is meant: the one that is shown, or else that which makes pictures."""
    return dock.task if isinstance(dock.task, LongTask | LiveTask) else dock.picture


def _keeper(dock: Any) -> Any:
    """Return the button that keeps the bundle which is meant: the one that is chosen, or else that of the run."""
    return dock.task.keep_button if isinstance(dock.task, BundleTask) else dock.picture.runs.save.bundle


COMMANDS = {
    "open": Command(
        title="Open a burst or a recording in the dock", widget=lambda dock: dock.input.burst_button, may_open=True
    ),
    "open_folder": Command(
        title="Open a folder of frames in the dock", widget=lambda dock: dock.empty.folder_button, may_open=True
    ),
    "open_bundle": Command(title="Open a bundle in the dock", widget=lambda dock: dock.input.open_button),
    "live": Command(title="Show the live view", widget=lambda dock: dock.empty.live_button, may_open=True),
    "best_frames": Command(
        title="Take the best frames of the recording", widget=lambda dock: dock.input.frames.best_button
    ),
    "shown_frames": Command(
        title="Take the frames about the one shown", widget=lambda dock: dock.input.frames.shown_button
    ),
    "defaults": Command(
        title="Set all settings back to their defaults", widget=lambda dock: dock.picture.departures.back_button
    ),
    "start": Command(
        title="Start the task that is shown",
        key="Ctrl-Enter",
        widget=lambda dock: dock.task.start_button,
        may_open=True,
    ),
    "pause": Command(
        title="Pause the run, or continue it", key="Ctrl-Shift-H", widget=lambda dock: _going(dock).pause_button
    ),
    "stop": Command(title="Stop the run and keep it", key="Ctrl-Shift-E", widget=lambda dock: _going(dock).stop_button),
    "compare": Command(
        title="Compare two images", key="Ctrl-Shift-B", widget=lambda dock: dock.picture.runs.compare.button
    ),
    "save": Command(title="Save the result", key="Ctrl-Shift-S", widget=lambda dock: dock.picture.runs.save.result),
    "motion": Command(title="Save the motion", widget=lambda dock: dock.picture.runs.save.motion),
    "report": Command(title="Save the report", widget=lambda dock: dock.picture.display.card.report.button),
    "figure": Command(title="Save a figure", widget=lambda dock: dock.picture.display.card.report.figure_button),
    "keep_bundle": Command(title="Keep the bundle", widget=_keeper),
    "keep_burst": Command(title="Keep what was live as a burst", widget=lambda dock: dock.live.keep_button),
    "leave_out": Command(
        title="Leave out the frame that is shown, or take it in again",
        widget=lambda dock: dock.picture.display.card.steering.frame_button,
    ),
    "as_chosen": Command(
        title="Set the image back to what the run had come to",
        widget=lambda dock: dock.picture.display.card.steering.back_button,
    ),
    "continue_run": Command(title="Take the run further", widget=lambda dock: dock.picture.runs.continue_button),
    "remove_runs": Command(title="Remove the selected runs", widget=lambda dock: dock.picture.runs.remove_button),
    "undo_remove": Command(title="Bring back removed runs", widget=lambda dock: dock.picture.runs.undo_button),
    "copy_python": Command(title="Copy the call in Python", widget=lambda dock: dock.picture.copying.python),
    "copy_command": Command(title="Copy the command line", widget=lambda dock: dock.picture.copying.command),
    "next_run": Command(
        title="Next run",
        key="Ctrl-Shift-Down",
        widget=lambda dock: dock.picture.runs.table,
        act=lambda table: table.step(1),
    ),
    "previous_run": Command(
        title="Previous run",
        key="Ctrl-Shift-Up",
        widget=lambda dock: dock.picture.runs.table,
        act=lambda table: table.step(-1),
    ),
}


class KeyHints(QObject):
    """Adds to the tooltips of what has a key which key that is now.

    Parameters
    ----------
    dock : FiberBurstWidget
        Whose tooltips.
    """

    def __init__(self, dock: "FiberBurstWidget") -> None:
        super().__init__(dock)
        self._names: dict[QObject, list[str]] = {task.start_button: ["start"] for task in dock.tasks}
        for task in dock.tasks:
            if isinstance(task, LongTask | LiveTask):
                self._names |= {task.pause_button: ["pause"], task.stop_button: ["stop"]}
            if isinstance(task, BundleTask):
                self._names |= {task.keep_button: ["keep_bundle"]}
        for name, command in COMMANDS.items():
            names = self._names.setdefault(command.widget(dock), [])
            names.extend({name}.difference(names))
        for widget in self._names:
            widget.installEventFilter(self)

    @property
    def widgets(self) -> tuple[QObject, ...]:
        """What has a key, or could have one."""
        return tuple(self._names)

    def eventFilter(self, watched: QObject | None, event: QEvent | None) -> bool:
        """Show the tooltip with its keys."""
        if not isinstance(event, QHelpEvent) or event.type() != QEvent.Type.ToolTip or not isinstance(watched, QWidget):
            return False
        keys = ", ".join(filter(None, map(key_of, self._names[watched])))
        QToolTip.showText(event.globalPos(), watched.toolTip() + (f" ({keys})" if keys else ""), watched)
        return True


def key_of(name: str) -> str:
    """Return the key or keys that a command has now, as they are written on this system; "" where none."""
    given = COMMANDS[name].key
    keys = get_settings().shortcuts.shortcuts.get(_action(name), [] if given is None else [given])
    return " or ".join(str(Shortcut(key)) for key in keys)


def find_dock(viewer: "napari.viewer.Viewer", *, may_open: bool = False) -> "FiberBurstWidget | None":
    """Return the dock of a viewer; where there is none, open it if that is wanted."""
    from napari_fiberburst.plugin.dock import FiberBurstWidget

    # From the menu, napari opens the dock under another name than from here.
    docks = [widget for widget in viewer.window.dock_widgets.values() if isinstance(widget, FiberBurstWidget)]
    if not docks and may_open:
        docks = [viewer.window.add_plugin_dock_widget(PLUGIN, _WIDGET)[1]]
    return docks[0] if docks else None


def press(name: str) -> None:
    """Do what a command says in the dock of the current viewer, or say why that cannot be."""
    import napari

    viewer = napari.current_viewer()
    dock = None if viewer is None else find_dock(viewer, may_open=COMMANDS[name].may_open)
    if dock is None:
        show_info(f"{COMMANDS[name].title}: the dock is not open; take Plugins > {_WIDGET}")
        return
    widget = COMMANDS[name].widget(dock)
    if widget.isEnabled():
        COMMANDS[name].act(widget)
    else:
        show_info(f"{COMMANDS[name].title}: not now. {widget.toolTip()}")


start, pause, stop = partial(press, "start"), partial(press, "pause"), partial(press, "stop")
compare, save = partial(press, "compare"), partial(press, "save")
report, figure = partial(press, "report"), partial(press, "figure")
open_burst, open_folder, open_bundle = (
    partial(press, "open"),
    partial(press, "open_folder"),
    partial(press, "open_bundle"),
)
show_live = partial(press, "live")
best_frames, shown_frames = partial(press, "best_frames"), partial(press, "shown_frames")
defaults, motion = partial(press, "defaults"), partial(press, "motion")
keep_bundle, keep_burst = partial(press, "keep_bundle"), partial(press, "keep_burst")
leave_out, as_chosen = partial(press, "leave_out"), partial(press, "as_chosen")
continue_run, remove_runs = partial(press, "continue_run"), partial(press, "remove_runs")
undo_remove = partial(press, "undo_remove")
copy_python, copy_command = partial(press, "copy_python"), partial(press, "copy_command")
next_run, previous_run = partial(press, "next_run"), partial(press, "previous_run")


def save_film() -> None:
    """Save the layer that is selected as a film, or say why that cannot be; the dock need not be open."""
    import napari

    viewer = napari.current_viewer()
    if viewer is None:
        return
    dock = find_dock(viewer)
    ask_and_save(list(viewer.layers.selection), guess_axes if dock is None else dock.input.axes_of, dock)


def bind_keys() -> None:
    """Give the commands their keys, or those that the user has chosen. May be called more than once."""
    chosen = get_settings().shortcuts.shortcuts
    for name, command in COMMANDS.items():
        action_manager.register_action(_action(name), lambda viewer, name=name: press(name), command.title, ViewerModel)
        for key in chosen.get(_action(name), [] if command.key is None else [command.key]):
            action_manager.bind_shortcut(_action(name), key)
    # Acts on the layer that is selected, and has no use for the dock.
    action_manager.register_action(_action("film"), lambda viewer: save_film(), FILM_TITLE, ViewerModel)
    for key in chosen.get(_action("film"), []):
        action_manager.bind_shortcut(_action("film"), key)


def _action(name: str) -> str:
    return f"{PLUGIN}:{name}"
