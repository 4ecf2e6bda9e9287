"""The curves of runs: loss, the error of samples left out, and how close they come where the truth is known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import pyqtgraph
from napari.components import ViewerModel
from napari.utils.theme import get_theme
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QLabel, QVBoxLayout, QWidget

from napari_fiberburst.plugin.job import CurvePoint
from napari_fiberburst.plugin.kept_run import KeptRun

_HEIGHT = 150
_LINE_WIDTH, _SYMBOL_SIZE = 2, 5
# Of several runs, one after the other; then they begin anew.
_COLOURS = ("#4c9be8", "#ffb000", "#7bc86c", "#e8704c", "#c39bd3", "#4fc4c4", "#d977a8", "#a8a060")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Quantity:
    """One of the curves of a run.

    Attributes
    ----------
    name : str
        In the legend.
    plot : str
        Where it is drawn.
    colour : str
        Where it is of a single run.
    is_second : bool
        Whether it shares its plot with another quantity, which comes first.
    value : callable
        From a point and the camera's full scale to what is drawn; None or NaN where it is not known.
    """

    name: str
    plot: str
    colour: str
    is_second: bool = False
    value: Callable[[CurvePoint, float], float | None]


def _score(name: str, factor: float = 1.0) -> Callable[[CurvePoint, float], float | None]:
    return lambda point, _: None if point.scores is None else factor * getattr(point.scores, name)


def _squared_error(point: CurvePoint, span: float) -> float | None:
    """Return the error of samples left out as the loss has it: squared, with intensities from -1 to 1."""
    return None if point.held_out_rmse is None else (2 * point.held_out_rmse / span) ** 2


_FIT, _TRUTH, _MOTION = "loss", "PSNR (dB)", "motion (px)"
_QUANTITIES = (
    _Quantity(name="loss", plot=_FIT, colour="#4c9be8", value=lambda point, _: point.loss),
    _Quantity(name="error of samples left out", plot=_FIT, colour="#ffb000", is_second=True, value=_squared_error),
    _Quantity(name="PSNR", plot=_TRUTH, colour="#7bc86c", value=_score("psnr")),
    _Quantity(name="SSIM x 10", plot=_TRUTH, colour="#c39bd3", is_second=True, value=_score("ssim", 10)),
    _Quantity(name="motion off by", plot=_MOTION, colour="#e8704c", value=_score("motion_error")),
)


class Curves(QWidget):
    """Plots against the runs' seconds: what is fitted above; PSNR, SSIM and motion error below, where they are known.

    The curves of a single run are told apart by their colours. Of several, each run has a colour, which is named above
    the plots, and a second quantity in the same plot is dashed.

    Parameters
    ----------
    viewer : ViewerModel
        Whose theme to follow.
    """

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._plots = {label: _plot(label, log=label != _TRUTH) for label in (_FIT, _TRUTH, _MOTION)}
        # For each run, how many of its points are drawn, and its lines in the order of the quantities.
        self._drawn: list[int] = []
        self._lines: list[list[Any]] = []
        self._legend = QLabel()
        self._legend.setWordWrap(True)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self._legend)
        for plot in self._plots.values():
            layout.addWidget(plot)
        self.clear()
        self.open()

    def open(self) -> None:
        """Follow the viewer's theme, again where it was closed."""
        self._viewer.events.theme.connect(self.follow_theme)
        self.follow_theme()

    def clear(self) -> None:
        """Make way for other runs."""
        self._drawn, self._lines = [], []
        self._legend.setVisible(False)
        for label, plot in self._plots.items():
            plot.clear()
            plot.setVisible(label == _FIT)

    def show_runs(self, runs: Sequence[KeptRun]) -> None:
        """Draw all points of some runs so far; they are the same runs until everything is cleared."""
        if not self._lines:
            colours = [_COLOURS[number % len(_COLOURS)] for number in range(len(runs))]
            self._lines = [self._add_lines(None if len(runs) == 1 else colour) for colour in colours]
            self._drawn = [0] * len(runs)
            if len(runs) > 1:
                self._legend.setText(_legend_of([run.name for run in runs], colours))
                self._legend.setVisible(True)
        for number, run in enumerate(runs):
            if len(run.curve) != self._drawn[number]:
                self._drawn[number] = len(run.curve)
                self._draw(run, self._lines[number])

    def follow_theme(self, event: Any = None) -> None:
        """Take the viewer's colours."""
        theme = get_theme(self._viewer.theme)
        for plot in self._plots.values():
            plot.setBackground(theme.background.as_hex())
            legend = plot.plotItem.legend
            legend.setLabelTextColor(theme.text.as_hex())
            for _, label in legend.items:
                label.setText(label.text)  # or else it keeps its colour
            for side in ("left", "bottom"):
                plot.getAxis(side).setPen(theme.text.as_hex())
                plot.getAxis(side).setTextPen(theme.text.as_hex())

    def shut(self) -> None:
        """Follow the viewer no more. May be called more than once."""
        self._viewer.events.theme.disconnect(self.follow_theme)

    def _add_lines(self, colour: str | None) -> list[Any]:
        """Add an empty line for each quantity of a run: of one colour, or each of its own and named in the plot."""
        lines = []
        for quantity in _QUANTITIES:
            look: dict[str, Any] = {"name": quantity.name} if colour is None else {}
            if quantity.plot != _FIT or quantity.is_second:
                look |= _dots(colour or quantity.colour)
            pen = _pen(colour or quantity.colour, is_dashed=colour is not None and quantity.is_second)
            lines.append(self._plots[quantity.plot].plot(pen=pen, **look))
        return lines

    def _draw(self, run: KeptRun, lines: Sequence[Any]) -> None:
        seconds = np.array([point.seconds for point in run.curve])
        for quantity, line in zip(_QUANTITIES, lines, strict=True):
            values = np.array([quantity.value(point, run.span) for point in run.curve], dtype=np.float64)
            known = np.isfinite(values)
            line.setData(seconds[known], values[known])
            if known.any():
                self._plots[quantity.plot].setVisible(True)


def _legend_of(names: Sequence[str], colours: Sequence[str]) -> str:
    """Return which colour stands for which run, and what is dashed, for a label that knows HTML."""
    runs = [
        f'<span style="color: {colour}">■</span>&nbsp;{escape(name)}'
        for name, colour in zip(names, colours, strict=True)
    ]
    dashed = " and ".join(quantity.name for quantity in _QUANTITIES if quantity.is_second)
    return f"{' &nbsp; '.join(runs)}<br>dashed: {escape(dashed)}"


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


def _pen(colour: str, *, is_dashed: bool = False) -> Any:
    style = Qt.PenStyle.DashLine if is_dashed else Qt.PenStyle.SolidLine
    return pyqtgraph.mkPen(colour, width=_LINE_WIDTH, style=style)


def _dots(colour: str) -> dict[str, Any]:
    return {"symbol": "o", "symbolSize": _SYMBOL_SIZE, "symbolBrush": colour, "symbolPen": colour}
