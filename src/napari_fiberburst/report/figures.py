"""Figures of a report, as inline SVG: charts, and pictures with a scale bar. Colours are the page's, by class."""

import base64
import math
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_fiberburst.io.picture import encode_png

# Of a chart, in its own units, which are pixels where it is shown as large as it was drawn.
_WIDTH, _HEIGHT = 440, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 66, 12, 12, 44
# As wide is the label of a line, which stands to the right of it where there is room: curves fall from the left.
_LABEL = 110
# A curve of more points than this cannot be seen to have them.
_MOST_POINTS = 400
# A scale bar takes at most this part of a picture's width, and text this part of its larger side.
_BAR_PART, _TEXT_PART = 0.3, 0.04
_ROUND = (1, 2, 5, 10)
# An axis of fewer decades has numbers between them, too.
_DECADES_ALONE = 2


class Chart:
    """A chart of one or several curves, which grows part by part.

    Parameters
    ----------
    title : str
        What it shows, read out by screen readers.
    x_label, y_label : str
        What its axes are.
    x_range, y_range : (float, float)
        What they span.
    log_y : bool
        Whether the y axis is logarithmic.
    whole_x : bool
        Whether x counts something, such as frames, so that there is nothing between two of its whole numbers.
    """

    def __init__(
        self,
        title: str,
        x_label: str,
        y_label: str,
        x_range: tuple[float, float],
        y_range: tuple[float, float],
        *,
        log_y: bool = False,
        whole_x: bool = False,
    ) -> None:
        self._title, self._log_y, self._whole_x = title, log_y, whole_x
        self._x_range = x_range
        self._y_range = (math.log10(y_range[0]), math.log10(y_range[1])) if log_y else y_range
        self._parts: list[str] = []
        self._draw_axes(x_label, y_label)

    def line(self, x: ArrayLike, y: ArrayLike, *, kind: str = "curve") -> None:
        """Add a curve, with a gap where a value is not finite; `kind` is its class in the page's style."""
        points = np.column_stack([np.asarray(x, float), np.asarray(y, float)])
        points = points[np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_POINTS)).astype(int))]
        pen, path = "M", []
        for a, b in points:
            if not (math.isfinite(a) and math.isfinite(b) and (b > 0 or not self._log_y)):
                pen = "M"
                continue
            path.append(f"{pen}{self._x(a):.1f} {self._y(b):.1f}")
            pen = "L"
        self._parts.append(f'<path class="{kind}" d="{"".join(path)}"/>')

    def dots(self, x: ArrayLike, y: ArrayLike, names: Sequence[str], *, kind: str = "dot") -> None:
        """Add dots, each with a name that is shown where the pointer rests on it."""
        for a, b, name in zip(np.asarray(x, float), np.asarray(y, float), names, strict=True):
            if math.isfinite(a) and math.isfinite(b):
                self._parts.append(
                    f'<circle class="{kind}" cx="{self._x(a):.1f}" cy="{self._y(b):.1f}" r="3">'
                    f"<title>{escape(name)}</title></circle>"
                )

    def bars(self, heights: ArrayLike, names: Sequence[str]) -> None:
        """Add a bar at 0, 1 and so on; none where a height is not finite."""
        width = max(1.0, 0.8 * (self._x(1) - self._x(0)))
        for index, (height, name) in enumerate(zip(np.asarray(heights, float), names, strict=True)):
            if math.isfinite(height):
                top, foot = self._y(height), self._y(self._y_range[0])
                self._parts.append(
                    f'<rect class="bar" x="{self._x(index) - width / 2:.1f}" y="{top:.1f}" width="{width:.1f}" '
                    f'height="{max(foot - top, 0):.1f}"><title>{escape(name)}</title></rect>'
                )

    def mark_x(self, x: float, label: str) -> None:
        """Add a line from top to bottom, and what it stands for."""
        at = self._x(x)
        side = "end" if at > _WIDTH - _RIGHT - _LABEL else "start"
        shift = -5 if side == "end" else 5
        self._parts.append(
            f'<path class="mark" d="M{at:.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>'
            f'<text x="{at + shift:.1f}" y="{_TOP + 11}" text-anchor="{side}">{escape(label)}</text>'
        )

    def mark_y(self, y: float, label: str) -> None:
        """Add a line from left to right, and what it stands for."""
        at = self._y(y)
        self._parts.append(
            f'<path class="mark" d="M{_LEFT} {at:.1f}H{_WIDTH - _RIGHT}"/>'
            f'<text x="{_LEFT + 5}" y="{at - 5:.1f}">{escape(label)}</text>'
        )

    def svg(self) -> str:
        """Return the chart."""
        return (
            f'<svg class="chart" role="img" aria-label="{escape(self._title)}" viewBox="0 0 {_WIDTH} {_HEIGHT}">'
            f"{''.join(self._parts)}</svg>"
        )

    def _draw_axes(self, x_label: str, y_label: str) -> None:
        floor = _HEIGHT - _BOTTOM
        for value in ticks(*self._x_range, least=1 if self._whole_x else 0):
            at = self._x(value)
            self._parts.append(f'<path class="grid" d="M{at:.1f} {_TOP}V{floor}"/>')
            self._parts.append(f'<text x="{at:.1f}" y="{floor + 15}" text-anchor="middle">{value:g}</text>')
        for value in self._y_ticks():
            at = self._y(value)
            self._parts.append(f'<path class="grid" d="M{_LEFT} {at:.1f}H{_WIDTH - _RIGHT}"/>')
            self._parts.append(f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{value:g}</text>')
        self._parts.append(f'<path class="axis" d="M{_LEFT} {_TOP}V{floor}H{_WIDTH - _RIGHT}"/>')
        middle = (_LEFT + _WIDTH - _RIGHT) / 2
        self._parts.append(
            f'<text class="label" x="{middle}" y="{_HEIGHT - 8}" text-anchor="middle">{escape(x_label)}</text>'
        )
        self._parts.append(
            f'<text class="label" transform="translate(13 {(_TOP + floor) / 2}) rotate(-90)" text-anchor="middle">'
            f"{escape(y_label)}</text>"
        )

    def _y_ticks(self) -> list[float]:
        if not self._log_y:
            return ticks(*self._y_range)
        low, high = self._y_range
        decades = range(math.floor(low), math.ceil(high) + 1)
        factors = (1,) if high - low > _DECADES_ALONE else _ROUND[:-1]
        values = [factor * 10.0**power for power in decades for factor in factors]
        return [value for value in values if low <= math.log10(value) <= high]

    def _x(self, value: float) -> float:
        low, high = self._x_range
        return _LEFT + (value - low) / (high - low) * (_WIDTH - _LEFT - _RIGHT)

    def _y(self, value: float) -> float:
        low, high = self._y_range
        value = math.log10(value) if self._log_y else value
        return _HEIGHT - _BOTTOM - (value - low) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)


def picture(
    shown: NDArray[np.uint8], title: str, *, width: float, height: float, pixel: float = 1.0, unit: str = "px"
) -> str:
    """Return a picture with a scale bar.

    Parameters
    ----------
    shown : numpy.ndarray
        Of 8 bits, as `napari_fiberburst.io.picture.as_picture` makes it.
    title : str
        What it shows.
    width, height : float
        How many frame pixels it covers.
    pixel : float
        Width of a frame pixel, in `unit`.
    """
    data = base64.b64encode(encode_png(shown)).decode()
    text = max(width, height) * _TEXT_PART
    length = round_below(_BAR_PART * width * pixel)
    bar, left, base = length / pixel, 0.7 * text, height - 0.8 * text
    label = escape(f"{length:g} {unit}")
    return (
        f'<svg class="picture" role="img" aria-label="{escape(title)}" viewBox="0 0 {width:g} {height:g}">'
        f'<image href="data:image/png;base64,{data}" width="{width:g}" height="{height:g}" preserveAspectRatio="none"/>'
        f'<g class="scale" font-size="{text:.3g}" stroke-width="{0.2 * text:.3g}">'
        f'<rect x="{left:.4g}" y="{base:.6g}" width="{bar:.6g}" height="{0.25 * text:.3g}"/>'
        f'<text x="{left:.4g}" y="{base - 0.4 * text:.6g}">{label}</text></g></svg>'
    )


def path_of(points: NDArray[np.float64], frames: Iterable[int], unit: str) -> str:
    """Return a chart of the way (N, 2) that frames have gone, x to the right and y down, equal scales."""
    names = [f"frame {frame}" for frame in frames]
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    # As high as the chart allows, and as wide in proportion, so that a turn is seen as it was.
    aspect = (_WIDTH - _LEFT - _RIGHT) / (_HEIGHT - _TOP - _BOTTOM)
    half = max(float((high - low)[1]) / 2, float((high - low)[0]) / 2 / aspect, 1e-3) * 1.15
    chart = Chart(
        "the way of the frames",
        f"x, {unit}",
        f"y, {unit}",
        (middle[0] - half * aspect, middle[0] + half * aspect),
        (middle[1] + half, middle[1] - half),
    )
    x, y = points.T
    chart.line(x, y)
    chart.dots(x, y, names)
    chart.dots(x[:1], y[:1], names[:1], kind="first")
    return chart.svg()


def ticks(low: float, high: float, least: float = 0) -> list[float]:
    """Return four to ten round numbers from `low` to `high`, whichever is the larger, at least `least` apart."""
    low, high = min(low, high), max(low, high)
    step = max(round_below((high - low) / 4), least)
    first = math.ceil(low / step - 1e-9)
    return [float(f"{step * number:.12g}") + 0.0 for number in range(first, math.floor(high / step + 1e-9) + 1)]


def round_below(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is no larger than a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(factor * power for factor in _ROUND if factor * power <= value * (1 + 1e-9))
