"""Any image layer with a time axis as a film: asked for, written in another thread, and told how far it is."""

import atexit
import io
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from napari.layers import Image, Layer
from napari.utils import cancelable_progress
from napari.utils.notifications import show_error, show_info
from qtpy.QtCore import QObject, Signal
from qtpy.QtWidgets import QFileDialog, QWidget
from superqt.utils import create_worker

from napari_fiberburst.errors import BurstError, FiberBurstError, OutputError
from napari_fiberburst.io.pyav import import_av
from napari_fiberburst.plugin.bursts import BurstSource, source_of
from napari_fiberburst.plugin.output_row import near, opened_from
from napari_fiberburst.plugin.problems import why
from napari_fiberburst.plugin.recordings import recording_in
from napari_fiberburst.plugin.runner import wait_for_workers

if TYPE_CHECKING:
    Limits = tuple[float, float]

# How far a film is, is told so often, in seconds.
_EVERY = 0.1
_KINDS = "Films (*.mp4 *.mkv *.avi)"


def ask_and_save(layers: Sequence[Layer], axes_of: Callable[[Image], str], parent: QWidget | None = None) -> None:
    """Ask where the film of a layer is to go and write it, or say why that cannot be.

    Parameters
    ----------
    layers : sequence of Layer
        What is selected: there is a film of one image layer alone.
    axes_of : callable
        Returns a letter for each axis of an image layer's data.
    parent : QWidget, optional
        Of the dialog.
    """
    try:
        layer = _one_of(layers)
        burst = _with_time(layer, axes_of(layer))
        import_av("saving a film", OutputError)
    except FiberBurstError as error:
        show_error(str(error))
        return
    path, _ = QFileDialog.getSaveFileName(parent, "Save film", str(_suggested(layer)), _KINDS)
    if path:
        # The dialog has asked whether a file may be replaced, but it knows nothing of an ending that is added here.
        chosen = Path(path)
        target = chosen if chosen.suffix else chosen.with_suffix(".mp4")
        save(layer, burst, target, may_replace=target == chosen)


def save(layer: Image, burst: BurstSource, target: Path, *, may_replace: bool) -> None:
    """Write the film of a layer in another thread, or say why that cannot be."""
    from napari_fiberburst.recordings.movie import check_movie

    try:
        if target.resolve() in {path.resolve() for path in opened_from(layer)}:
            raise OutputError(f"{target} is what the film is made from, and would be lost; choose another name")
        if target.resolve() in {writing.target.resolve() for writing in _GOING}:
            raise OutputError(f"{target} is being written just now; choose another name, or wait for its end")
        if target.exists() and not may_replace:
            raise OutputError(f"{target} is there already; choose it itself to replace it, or another name")
        check_movie(target, may_replace=True)
    except FiberBurstError as error:
        show_error(str(error))
        return
    Writing(burst, limits_of_layer(layer), target).start()


def limits_of_layer(layer: Image) -> "Limits":
    """Return which intensities a layer shows black and white."""
    if not layer.rgb:
        low, high = layer.contrast_limits
        return float(low), float(high)
    # napari shows colours as they are.
    return 0.0, float(np.iinfo(layer.dtype).max) if np.issubdtype(layer.dtype, np.integer) else 1.0


class Writing(QObject):
    """A film that is being written; napari's list of activities says how far it is, and can cancel it.

    Parameters
    ----------
    burst : BurstSource
        Its frames.
    limits : (float, float)
        What is shown black and white.
    target : Path
        Where to write; what is there is replaced.
    """

    _written = Signal(int)

    def __init__(self, burst: BurstSource, limits: "Limits", target: Path) -> None:
        super().__init__()
        self.target = target
        self._work = partial(_write, burst, limits, target, self._note)
        self._is_stopped = False
        self._count, self._told = 0, 0.0
        # Where there is no window for it, napari's bar would go to the terminal.
        self._bar = cancelable_progress(total=burst.shape[0], desc=f"film {target.name}", file=io.StringIO())
        self._written.connect(self._show)

    def start(self) -> None:
        """Begin, in another thread."""
        _GOING.append(self)
        atexit.register(self._stop)
        show_info(f"writing {self.target.name}: napari's activities, at the bottom right, tell how far it is")
        create_worker(
            self._work,
            _connect={"returned": self._take, "errored": self._take_error},
            _ignore_errors=True,
        )

    def _note(self) -> None:
        """Take note of one more frame; called in the thread that writes."""
        self._count += 1
        if self._is_stopped or self._bar.is_canceled:
            raise _CancelledError
        if time.monotonic() - self._told > _EVERY:
            self._told = time.monotonic()
            self._written.emit(self._count)

    def _show(self, count: int) -> None:
        if self in _GOING:
            self._bar.update(count - self._bar.n)

    def _take(self, path: Path) -> None:
        self._end()
        show_info(f"wrote {path}")

    def _take_error(self, error: Exception) -> None:
        self._end()
        if isinstance(error, _CancelledError):
            show_info(f"{self.target} was not written: cancelled")
        else:
            show_error(why(error, "a film could not be saved"))

    def _end(self) -> None:
        _GOING.remove(self)
        atexit.unregister(self._stop)
        self._bar.close()

    def _stop(self) -> None:
        """Give up, because Python is ending."""
        self._is_stopped = True
        wait_for_workers()


# Who writes is kept here, because nobody else holds it.
_GOING: list[Writing] = []


class _CancelledError(Exception):
    """The user has had enough of it."""


def _write(burst: BurstSource, limits: "Limits", target: Path, on_frame: Callable[[], object]) -> Path:
    from napari_fiberburst.recordings.movie import write_movie

    # No level is looked for: frames may be NaN.
    source = recording_in(burst, levels=(0.0, 1.0))
    return write_movie(source, target, scale_bar=True, limits=limits, on_frame=on_frame)


def _one_of(layers: Sequence[Layer]) -> Image:
    """Return the image layer that is selected.

    Raises
    ------
    OutputError
        None is, or several are, or another kind of layer.
    """
    wanted = "select one image layer with a time axis"
    if not layers:
        raise OutputError(f"no layer is selected; {wanted}")
    if len(layers) > 1:
        raise OutputError(f"{len(layers)} layers are selected, and a film shows one; {wanted}")
    layer = layers[0]
    if not isinstance(layer, Image):
        raise OutputError(f"{layer.name!r} is a layer of {type(layer).__name__.lower()}, not an image; {wanted}")
    return layer


def _with_time(layer: Image, axes: str) -> BurstSource:
    """Return the frames of a layer.

    Raises
    ------
    FiberBurstError
        It has no time axis, or further axes that are neither channels nor of length 1.
    """
    burst = source_of([layer], axes)
    if axes and "T" not in axes:
        raise OutputError(f"layer {layer.name!r} has no time axis, its axes are {axes}; select one that has")
    try:
        count = burst.shape[0]
    except BurstError as error:
        raise OutputError(f"no film can be made of layer {layer.name!r}: {error}") from error
    if count < 2:
        raise OutputError(f"layer {layer.name!r} has one frame; a film needs a time axis of two or more")
    return burst


def _suggested(layer: Image) -> Path:
    """Return a name beside what a layer was opened from, but not that."""
    place = near(layer)
    path = place.with_name(f"{place.name}.mp4")
    return path if path not in opened_from(layer) else place.with_name(f"{place.name}-film.mp4")
