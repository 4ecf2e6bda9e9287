"""The resolution chart behind a real bundle: what of it an image shows, and how much honeycomb is left.

The burst is PyFibreBundle's test data (Mike Hughes, MIT licence): 12 frames of a USAF-1951 chart, groups 6 and 7,
through 27,800 cores. The places below are where that burst's first frame shows the chart, (x, y) in pixels, integers at
pixel centres. An image of it is read through the `Canvas` that says where it lies on that frame.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from napari_fiberburst.data.canvas import Canvas

FRAME = (960, 1280)
BLACK_LEVEL = 3
# The direction across the vertical bars, from x towards y; and pixels to a line pair of element 1 of group 6.
ANGLE = math.radians(-11.3)
COARSEST = 24.80
# (group, element, direction of the bars) to the middle bar's centre; H bars run along x, V bars along y.
PLACES = {
    (6, 1, "H"): (465.43, 341.53), (6, 1, "V"): (549.04, 324.99), (6, 2, "H"): (797.46, 572.73),
    (6, 2, "V"): (722.75, 587.24), (6, 3, "H"): (782.71, 484.13), (6, 3, "V"): (716.35, 497.14),
    (6, 4, "H"): (769.74, 404.67), (6, 4, "V"): (710.60, 416.22), (6, 5, "H"): (758.18, 334.37),
    (6, 5, "V"): (705.54, 344.92), (6, 6, "H"): (747.97, 271.63), (6, 6, "V"): (700.81, 281.21),
    (7, 1, "H"): (508.87, 642.52), (7, 1, "V"): (551.06, 634.12), (7, 2, "H"): (498.10, 593.23),
    (7, 2, "V"): (535.36, 585.82), (7, 3, "H"): (487.70, 549.30), (7, 3, "V"): (520.98, 542.43),
    (7, 4, "H"): (478.89, 510.24), (7, 4, "V"): (508.30, 504.42), (7, 5, "H"): (470.40, 475.28),
    (7, 5, "V"): (496.98, 470.21), (7, 6, "H"): (463.22, 444.19), (7, 6, "V"): (487.37, 439.79),
}  # fmt: skip
# A solid square (centre, half a side), discs of clear glass (centre, radius), clear boxes (x0, y0, x1, y1).
SQUARE = (632.5, 605.5, 17.0)
CLEAR_DISCS = ((605, 430, 14), (575, 560, 11), (640, 300, 16), (600, 690, 16), (655, 440, 14), (560, 420, 12))
CLEAR_BOXES = ((470, 90, 650, 225), (480, 735, 800, 850), (850, 300, 930, 470))
# Places that a template is put at to learn what grain alone looks like.
BLANKS = 300
# The lattice's rows are so many cycles a pixel apart: a ring in the power spectrum, and the flanks beside it.
LATTICE = 0.2187
RING = (0.85, 1.15)


@dataclass(frozen=True, eq=False)
class Shown:
    """An image of the chart, to be read at frame-0 points.

    Parameters
    ----------
    image : numpy.ndarray
        (H, W); NaN counts as the mean.
    canvas : Canvas
        Where it lies on frame 0.
    """

    image: NDArray[np.floating]
    canvas: Canvas

    @cached_property
    def _coefficients(self) -> NDArray[np.float64]:
        known = np.where(np.isfinite(self.image), self.image, np.nanmean(self.image)).astype(np.float64)
        coefficients: NDArray[np.float64] = spline_filter(known, 3, mode="mirror")
        return coefficients

    @cached_property
    def levels(self) -> tuple[float, float]:
        """The dark of the chart and the light of clear glass.

        The dark is the solid square's or, where that is greyed by a flat field taken from the burst itself, the
        coarsest bars'.
        """
        x, y, half = SQUARE
        square = self.at(*_turned(x, y, *np.meshgrid(*[np.linspace(-half, half, 35)] * 2))).mean()
        bars = [self._profile(place)[2] for place in list(PLACES)[:3]]
        dark = min(square, float(np.mean([self._windows(bar, 0.0)[0].mean() for bar in bars])))
        clear = []
        for x, y, radius in CLEAR_DISCS:
            across, down = np.meshgrid(*[np.arange(-radius, radius + 1.0)] * 2)
            inside = np.hypot(across, down) <= radius
            clear.append(self.at(x + across[inside], y + down[inside]).mean())
        return dark, float(np.mean(clear))

    def at(self, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the image at frame-0 points, by cubic splines."""
        points = np.stack([x, y, np.ones_like(x)])
        column, row, depth = np.tensordot(np.linalg.inv(self.canvas.reference_from_image), points, axes=1)
        found: NDArray[np.float64] = map_coordinates(
            self._coefficients, (row / depth, column / depth), order=3, mode="nearest", prefilter=False
        )
        return found

    def profile(self, group: int, element: int, bars: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the places across an element's bars, pixels from its middle, and the light there, 0 to 1."""
        dark, light = self.levels
        across, _, seen = self._profile((group, element, bars))
        return across, (seen.mean(axis=1) - dark) / (light - dark)

    def elements(self) -> Iterator[dict[str, float | str | bool]]:
        """Yield the modulation of each element and direction, and whether it is resolved.

        M is (gap - bar) / (light - dark), the means of two gaps and three bars, read in windows of a quarter of a
        period along the middle 70 % of the bars. Resolved is what has M of at least 0.1, 0.05 at every one of the four
        edges and in both halves of the bars, and more than 95 % of the same templates on clear glass.
        """
        rng = np.random.default_rng(0)
        for place in sorted(PLACES):
            period = period_of(*place[:2])
            found = self._modulation(place, PLACES[place])
            blank = []
            for number in range(BLANKS):
                x0, y0, x1, y1 = CLEAR_BOXES[number % len(CLEAR_BOXES)]
                margin = 1.9 * period
                spot = rng.uniform(
                    (x0 + margin, y0 + margin), np.maximum((x1 - margin, y1 - margin), (x0 + margin, y0 + margin))
                )
                blank.append(self._modulation(place, (spot[0], spot[1]))[0])
            grain = float(np.percentile(blank, 95))
            modulation, weakest_edge, weaker_half = found
            resolved = modulation > max(0.1, grain) and weakest_edge > 0.05 and weaker_half > 0.05
            group, element, bars = place
            yield {
                "group": group, "element": element, "bars": bars, "period": period,
                "modulation": modulation, "grain": grain, "resolved": bool(resolved),
            }  # fmt: skip

    def ring(self) -> float:
        """Return the lattice's part of what clear glass shows, in parts of the chart's contrast."""
        power, pixels = 0.0, 0
        for x0, y0, x1, y1 in CLEAR_BOXES:
            x, y = np.meshgrid(np.arange(x0, x1, dtype=float), np.arange(y0, y1, dtype=float))
            seen = self.at(x, y)
            seen = seen - gaussian_filter(seen, 12, mode="nearest")
            window = np.outer(np.hanning(len(seen)), np.hanning(seen.shape[1]))
            seen = (seen - (seen * window).sum() / window.sum()) * window
            spectrum = np.abs(np.fft.fft2(seen)) ** 2 / (window**2).sum()  # its sum is the variance times the pixels
            radius = np.hypot(np.fft.fftfreq(len(seen))[:, None], np.fft.fftfreq(seen.shape[1])) / LATTICE
            power += spectrum[(radius > RING[0]) & (radius < RING[1])].sum()
            pixels += seen.size
        dark, light = self.levels
        return math.sqrt(power / pixels) / abs(light - dark)

    def _profile(
        self, place: tuple[int, int, str], centre: tuple[float, float] | None = None
    ) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
        """Return places across the bars, the period, and the image there, (across, along)."""
        group, element, bars = place
        period = period_of(group, element)
        across, along = np.linspace(-1.75, 1.75, 141) * period, np.linspace(-0.875, 0.875, 41) * period
        u, v = np.meshgrid(across, along, indexing="ij")
        x, y = _turned(*(centre or PLACES[place]), *((u, v) if bars == "V" else (-v, u)))
        return across, period, self.at(x, y)

    def _windows(self, seen: NDArray[np.float64], shift: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the light of the three bars and the two gaps of a profile, `shift` periods off."""
        along = seen.mean(axis=1) if seen.ndim == 2 else seen
        across = np.linspace(-1.75, 1.75, len(along)) - shift
        bars, gaps = (
            np.array([along[np.abs(across - middle) <= 0.125 + 1e-9].mean() for middle in middles])
            for middles in ((-1, 0, 1), (-0.5, 0.5))
        )
        return bars, gaps

    def _modulation(self, place: tuple[int, int, str], centre: tuple[float, float]) -> tuple[float, float, float]:
        """Return M, at the weakest edge and in the weaker half too; an element may be 0.12 periods off its place."""
        _, _, seen = self._profile(place, centre)
        dark, light = self.levels
        along = seen.mean(axis=1)

        def depth(profile: NDArray[np.float64], shift: float) -> float:
            bars, gaps = self._windows(profile, shift)
            return float(gaps.mean() - bars.mean()) / (light - dark)

        shift = max(np.linspace(-0.12, 0.12, 13), key=lambda shift: depth(along, shift))
        bars, gaps = self._windows(along, shift)
        edges = (gaps[0] - bars[0], gaps[0] - bars[1], gaps[1] - bars[1], gaps[1] - bars[2])
        halves = (seen[:, :21].mean(axis=1), seen[:, 20:].mean(axis=1))
        return depth(along, shift), float(min(edges)) / (light - dark), min(depth(half, shift) for half in halves)


def period_of(group: int, element: int) -> float:
    """Return the pixels to a line pair."""
    return COARSEST * 64 / 2.0 ** (group + (element - 1) / 6)


def finest(elements: list[dict[str, float | str | bool]]) -> str:
    """Return the last element that is resolved in both directions, with none before it that is not."""
    last = "none"
    for group, element in sorted({place[:2] for place in PLACES}):
        both = [row["resolved"] for row in elements if (row["group"], row["element"]) == (group, element)]
        if not all(both):
            break
        last = f"G{group}E{element}"
    return last


def _turned(
    x: float, y: float, across: NDArray[np.floating], along: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points so far across and along the vertical bars from (x, y)."""
    cosine, sine = math.cos(ANGLE), math.sin(ANGLE)
    return x + across * cosine - along * sine, y + across * sine + along * cosine
