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
from napari_fiberburst.plugin.tasks.live import LiveTask
from napari_fiberburst.plugin.tasks.long import LongTask

if TYPE_CHECKING:
    import napari

    from napari_fiberburst.plugin.dock import FiberBurstWidget

_WIDGET = "Fiber burst reconstruction"


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
    """

    title: str
    key: str | None
    widget: Callable[[Any], QWidget]
    act: Callable[[Any], None] = QAbstractButton.click


def _going(dock: Any) -> Any:
    """Return the task whose run is meant: the one that is shown, or else that which makes pictures."""
    return dock.task if isinstance(dock.task, LongTask | LiveTask) else dock.picture


COMMANDS = {
    "start": Command(
        title="Start the task that is shown", key="Ctrl-Enter", widget=lambda dock: dock.task.start_button
    ),
    "pause": Command(
        title="Pause the run, or continue it", key="Ctrl-Shift-H", widget=lambda dock: _going(dock).pause_button
    ),
    "stop": Command(title="Stop the run and keep it", key="Ctrl-Shift-E", widget=lambda dock: _going(dock).stop_button),
    "compare": Command(
        title="Compare two images", key="Ctrl-Shift-B", widget=lambda dock: dock.picture.runs.compare.button
    ),
    "save": Command(title="Save the result", key="Ctrl-Shift-S", widget=lambda dock: dock.picture.runs.save.result),
    "report": Command(title="Save the report", key=None, widget=lambda dock: dock.picture.display.card.report.button),
    "figure": Command(
        title="Save a figure", key=None, widget=lambda dock: dock.picture.display.card.report.figure_button
    ),
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
        for name, command in COMMANDS.items():
            names = self._names.setdefault(command.widget(dock), [])
            names.extend({name}.difference(names))
        for widget in self._names:
            widget.installEventFilter(self)

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
    dock = None if viewer is None else find_dock(viewer, may_open=name == "start")
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
next_run, previous_run = partial(press, "next_run"), partial(press, "previous_run")


def show_live() -> None:
    """Open the dock at the live view."""
    import napari

    viewer = napari.current_viewer()
    dock = None if viewer is None else find_dock(viewer, may_open=True)
    if dock is not None:
        dock.choose_task(LiveTask)


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


def _action(name: str) -> str:
    return f"{PLUGIN}:{name}"
