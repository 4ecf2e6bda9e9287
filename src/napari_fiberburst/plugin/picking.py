"""A click on a frame's outline."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from napari_fiberburst.plugin.kept_run import KeptRun

if TYPE_CHECKING:
    from napari.components import ViewerModel

# A plain click moves the view, or selects shapes, and a double click zooms.
_MODIFIER, _BUTTON = "Control", 1
_MODE = "pan_zoom"


class FramePicker:
    """Says on which frame's outline a user has clicked with Ctrl held, whatever layer is selected.

    Parameters
    ----------
    viewer : ViewerModel
        Where.
    picked : callable
        Is given the frame's number.
    """

    def __init__(self, viewer: "ViewerModel", picked: Callable[[int], None]) -> None:
        self._viewer, self._picked = viewer, picked
        self._run: KeptRun | None = None

    def open(self) -> None:
        """Follow the mouse."""
        if self._take_click not in self._viewer.mouse_drag_callbacks:
            self._viewer.mouse_drag_callbacks.append(self._take_click)

    def shut(self) -> None:
        """Follow it no more. May be called more than once."""
        if self._take_click in self._viewer.mouse_drag_callbacks:
            self._viewer.mouse_drag_callbacks.remove(self._take_click)

    def follow(self, run: KeptRun | None) -> None:
        """Let it be the outlines of this run."""
        self._run = run

    def _take_click(self, viewer: Any, event: Any) -> None:
        active = viewer.layers.selection.active
        is_idle = active is None or getattr(active, "mode", _MODE) == _MODE  # nobody draws or edits
        if self._run is None or event.button != _BUTTON or _MODIFIER not in event.modifiers or not is_idle:
            return
        frame = self._run.layers.outlined_at(event)
        if frame is not None:
            self._picked(frame)
