"""What the burst that is chosen looks like, before it is run: some of its frames, and what is seen of it."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from qtpy.QtCore import Qt
from qtpy.QtGui import QImage, QPixmap
from qtpy.QtWidgets import QLabel, QVBoxLayout, QWidget
from superqt.utils import create_worker

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.plugin.bursts import BurstSource
from napari_fiberburst.plugin.drivers import without_clash
from napari_fiberburst.plugin.input_box import InputBox
from napari_fiberburst.plugin.problems import why

if TYPE_CHECKING:
    from napari_fiberburst.pipeline.glance import Glance

# Thumbnails are this high; the strip is no wider than this, and shows no more frames.
_HEIGHT, _WIDTH, _MOST = 40, 320, 7


# The layers' arrays, why they are no burst, and axes, region and frames of one.
_Asked = tuple[list[Any], str, Any]


class GlanceBox(QWidget):
    """Looks at the burst that is chosen, in another thread, and says what it sees.

    Parameters
    ----------
    chosen : InputBox
        Where the burst is chosen.

    Attributes
    ----------
    strip : QLabel
        Some of the frames, side by side.
    words : QLabel
        What the burst is, and what speaks against it; or why it cannot be run.
    """

    def __init__(self, chosen: InputBox, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._input = chosen
        self._asked: _Asked | None = None
        self._is_brief = False
        self._said = ""
        self.strip, self.words = QLabel(), QLabel()
        self.strip.setAccessibleName("frames of the burst")
        self.strip.setToolTip("Some frames of the burst.")
        self.words.setWordWrap(True)
        self.words.setTextFormat(Qt.TextFormat.PlainText)  # with names that users have given
        self.words.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.words.setToolTip("What a few frames show; a run measures all of it anew.")
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.strip)
        column.addWidget(self.words)
        chosen.changed.connect(self.look)
        self.look()

    def look(self) -> None:
        """Look at what is chosen now, unless that is what was looked at."""
        # The layers' own arrays, because what is made of them is another one each time.
        arrays = [layer.data for layer in self._input.layers]
        try:
            source: BurstSource | None = self._input.source()
            problem = ""
        except FiberBurstError as error:
            source, problem = None, str(error)
        asked = (arrays, problem, source and (source.axes, source.region, source.chosen))
        if self._asked is not None and _is_same(asked, self._asked):
            return
        self._asked = asked
        self.strip.clear()
        self._show_strip()
        if source is None:
            self._tell(problem if arrays else "")
            return
        self._said = in_words(source)
        self._tell(self._said)
        create_worker(
            seen_of,
            source,
            asked,
            _connect={"returned": self._take, "errored": self._take_error},
            _ignore_errors=True,
        )

    def set_brief(self, *, is_brief: bool) -> None:
        """Show words alone, because there is a result to look at."""
        self._is_brief = is_brief
        self._show_strip()

    def _show_strip(self) -> None:
        self.strip.setVisible(not self._is_brief and not self.strip.pixmap().isNull())

    def _take(self, seen: "tuple[_Asked, Glance, NDArray[np.uint8]]") -> None:
        asked, glance, frames = seen
        if asked is not self._asked:
            return  # something else was chosen meanwhile
        self._tell(f"{self._said} · {glance.words}", *glance.warnings)
        height, width = frames.shape[:2]
        image = QImage(frames.tobytes(), width, height, 3 * width, QImage.Format.Format_RGB888)
        self.strip.setPixmap(QPixmap.fromImage(image))
        self._show_strip()

    def _take_error(self, error: Exception) -> None:
        self._tell(self._said, f"The frames cannot be read: {why(error, 'the burst could not be looked at')}")

    def _tell(self, *lines: str) -> None:
        self.words.setText("\n".join(lines))
        self.words.setVisible(any(lines))


def _is_same(one: _Asked, other: _Asked) -> bool:
    is_of_same = len(one[0]) == len(other[0]) and all(a is b for a, b in zip(one[0], other[0], strict=True))
    return is_of_same and one[1:] == other[1:]


def in_words(source: BurstSource) -> str:
    """Return what a burst is, as far as that needs no look at its pixels."""
    frames, height, width, channels = source.shape
    kinds = {1: "grey", 3: "RGB"}
    parts = [
        f"{frames} frame{'s' if frames > 1 else ''}{_among(source)}",
        f"{height} x {width}",
        kinds.get(channels, f"{channels} channels"),
    ]
    if source.pixel_size is not None:
        parts.append(f"{sum(source.pixel_size) / 2:.3g} {source.unit}")
    return ", ".join(parts)


def _among(source: BurstSource) -> str:
    """Return which frames of a recording are meant."""
    return "" if source.chosen is None else f" of a recording, {source.chosen[0]} to {source.chosen[-1]}"


def seen_of(source: BurstSource, asked: "_Asked") -> "tuple[_Asked, Glance, NDArray[np.uint8]]":
    """Look at a burst; return what was asked for, what is seen, and thumbnails side by side, (H, W, 3)."""
    from napari_fiberburst.pipeline.glance import glance, some_of  # torch takes seconds to load

    with without_clash():
        burst = source.some(*some_of(*source.shape[:3])).read()
        return asked, glance(burst), _strip(burst.frames)


def _strip(frames: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return frames (T, H, W, C) in [0, 1] as thumbnails side by side, (H, W, 3)."""
    step = max(1, frames.shape[1] // _HEIGHT)
    # The mean of a block, because cores and the gaps between them would beat with the thumbnails' pixels.
    height, width = (side // step * step for side in frames.shape[1:3])
    blocks = frames[:, :height, :width].reshape(len(frames), height // step, step, width // step, step, -1)
    small = blocks.mean(axis=(2, 4))
    small = small[..., :3] if small.shape[3] >= 3 else small[..., :1].repeat(3, axis=3)
    shown = min(_MOST, len(small), max(1, _WIDTH // (small.shape[2] + 2)))
    bright = max(float(np.quantile(small, 0.99)), 1e-6)
    edged = np.pad(small[:shown], ((0, 0), (0, 0), (0, 2), (0, 0)))
    return np.ascontiguousarray(np.clip(255 * np.hstack(list(edged)) / bright, 0, 255).astype(np.uint8))
