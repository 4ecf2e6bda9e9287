"""The curves of a run: loss, the error of samples left out, and how close it comes where the truth is known."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyqtgraph
from napari.components import ViewerModel
from napari.utils.theme import get_theme
from numpy.typing import NDArray
from qtpy.QtWidgets import QVBoxLayout, QWidget

from napari_fiberburst.plugin.job import CurvePoint

_HEIGHT = 150
_LOSS, _ERROR, _PSNR, _SSIM, _MOTION = "#4c9be8", "#ffb000", "#7bc86c", "#c39bd3", "#e8704c"
_LINE_WIDTH = 2


class Curves(QWidget):
    """Plots against the run's seconds: what is fitted above; PSNR, SSIM and motion error below, where they are known.

    Parameters
    ----------
    viewer : ViewerModel
        Whose theme to follow.
    """

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._fit, self._truth, self._motion = (
            _plot("loss", log=True),
            _plot("PSNR (dB)"),
            _plot("motion (px)", log=True),
        )
        self._lines = {
            "loss": self._fit.plot(pen=_pen(_LOSS), name="loss"),
            "held_out_rmse": self._fit.plot(
                pen=_pen(_ERROR), symbol="o", symbolSize=5, name="error of samples left out"
            ),
            "psnr": self._truth.plot(pen=_pen(_PSNR), symbol="o", symbolSize=5, name="PSNR"),
            "ssim": self._truth.plot(pen=_pen(_SSIM), symbol="o", symbolSize=5, name="SSIM x 10"),
            "motion_error": self._motion.plot(pen=_pen(_MOTION), symbol="o", symbolSize=5, name="motion off by"),
        }
        self._drawn = 0
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        for plot in (self._fit, self._truth, self._motion):
            layout.addWidget(plot)
        self.clear()
        self.open()

    def open(self) -> None:
        """Follow the viewer's theme, again where it was closed."""
        self._viewer.events.theme.connect(self.follow_theme)
        self.follow_theme()

    def clear(self) -> None:
        """Make way for another run."""
        self._drawn = 0
        for line in self._lines.values():
            line.setData([], [])
        self._truth.setVisible(False)
        self._motion.setVisible(False)

    def show_points(self, points: Sequence[CurvePoint], span: float) -> None:
        """Draw all points of a run so far; errors are shown as parts of `span`, the camera's full scale."""
        if len(points) == self._drawn:
            return
        self._drawn = len(points)
        scored = [(point.seconds, point.scores) for point in points if point.scores is not None]
        seconds = np.array([point.seconds for point in points])
        self._draw("loss", seconds, [point.loss for point in points])
        errors = [np.nan if point.held_out_rmse is None else (2 * point.held_out_rmse / span) ** 2 for point in points]
        self._draw("held_out_rmse", seconds, errors)
        if scored:
            at = np.array([moment for moment, _ in scored])
            self._truth.setVisible(True)
            self._motion.setVisible(True)
            self._draw("psnr", at, [scores.psnr for _, scores in scored])
            self._draw("ssim", at, [10 * scores.ssim for _, scores in scored])
            self._draw("motion_error", at, [scores.motion_error for _, scores in scored])

    def follow_theme(self, event: Any = None) -> None:
        """Take the viewer's colours."""
        theme = get_theme(self._viewer.theme)
        for plot in (self._fit, self._truth, self._motion):
            plot.setBackground(theme.background.as_hex())
            for side in ("left", "bottom"):
                plot.getAxis(side).setPen(theme.text.as_hex())
                plot.getAxis(side).setTextPen(theme.text.as_hex())

    def shut(self) -> None:
        """Follow the viewer no more. May be called more than once."""
        self._viewer.events.theme.disconnect(self.follow_theme)

    def _draw(self, name: str, seconds: NDArray[np.float64], values: Sequence[float]) -> None:
        known = np.isfinite(np.array(values, dtype=np.float64))
        self._lines[name].setData(seconds[known], np.array(values, dtype=np.float64)[known])


def _plot(label: str, *, log: bool = False) -> pyqtgraph.PlotWidget:
    plot = pyqtgraph.PlotWidget()
    plot.setFixedHeight(_HEIGHT)
    plot.setLogMode(y=log)
    plot.setLabel("left", label)
    plot.getAxis("left").enableAutoSIPrefix(False)  # "x0.001" on an axis of powers of ten helps nobody
    plot.setLabel("bottom", "seconds")
    plot.addLegend(offset=(-5, 5), labelTextSize="8pt")
    plot.setMenuEnabled(False)
    # All of a curve is always in sight: what the mouse could move, nothing here would bring back.
    plot.setMouseEnabled(x=False, y=False)
    plot.hideButtons()
    return plot


def _pen(colour: str) -> Any:
    return pyqtgraph.mkPen(colour, width=_LINE_WIDTH)
