"""What there is to see: images that scikit-image brings along, at their own resolution, and drawn ones."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import skimage.data
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from napari_fiberburst.errors import SettingsError

# Quadratic splines take two thirds of the time of cubic ones, and the scene *is* the spline, so nothing is lost.
_SPLINE_ORDER: Final = 2
# How far beyond frame 0's field a scene is kept, in parts of the field; farther out it is its own reflection.
_MARGIN = 0.5
# How far a scene is kept beyond frame 0's field, pixels: to the left, above, to the right, and below.
Reach = tuple[int, int, int, int]
# Of a drawn scene.
_MOST_PIXELS = 2**24


@dataclass(frozen=True, eq=False)
class Scene:
    """An image without bundle or motion, known everywhere.

    Parameters
    ----------
    image : numpy.ndarray
        (H, W, C) float32 in [0, 1].
    origin : (float, float)
        The image's pixel (x, y) that lies at frame 0's pixel (0, 0).
    """

    image: NDArray[np.float32]
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        coefficients = [
            spline_filter(band, order=_SPLINE_ORDER, mode="mirror", output=np.float32) for band in self._bands()
        ]
        object.__setattr__(self, "_coefficients", coefficients)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(self.image.shape[2])

    def sample(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the scene (..., C) at frame-0 points (..., 2) by splines, reflected beyond the image."""
        x, y = points[..., 0] + self.origin[0], points[..., 1] + self.origin[1]
        coefficients: list[NDArray[np.float32]] = self._coefficients  # type: ignore[attr-defined]
        bands = [
            map_coordinates(band, (y, x), order=_SPLINE_ORDER, mode="mirror", prefilter=False, output=np.float32)
            for band in coefficients
        ]
        return np.clip(np.stack(bands, axis=-1), 0, 1)

    def with_channels(self, channels: int) -> "Scene":
        """Return the scene in another number of channels: bands spread evenly over the spectrum it has.

        One channel is the mean of all.
        """
        if channels == self.channels:
            return self
        if channels == 1:
            return Scene(self.image.mean(axis=2, keepdims=True), self.origin)
        positions = np.linspace(0, self.channels - 1, channels)
        mixing = np.array([np.interp(positions, range(self.channels), row) for row in np.eye(self.channels)])
        return Scene((self.image @ mixing).astype(np.float32), self.origin)

    def _bands(self) -> list[NDArray[np.float32]]:
        return [self.image[..., band] for band in range(self.channels)]


def make_scene(name: str, shape: tuple[int, int], rng: Generator, reach: Reach | None = None) -> Scene:
    """Return a scene by name, with frame 0's field of `shape` (height, width) at its centre.

    Parameters
    ----------
    name : str
        One of `SCENES`: histology, retina, cat (photographs), usaf, tissue, cells (drawn).
    shape : (int, int)
        Of a frame. Photographs keep their own resolution: a larger frame sees more of them, then reflections.
    rng : numpy.random.Generator
        For what is drawn at random.
    reach : (int, int, int, int), optional
        Pixels to the left, above, to the right and below frame 0's field that are to be seen without reflections; the
        field then lies where a photograph holds all of them. Default, half a frame all round, or less.

    Raises
    ------
    SettingsError
        There is no scene of this name, or the photograph is smaller than its reach.
    """
    if name not in SCENES:
        raise SettingsError(f"unknown scene {name!r}; known: {', '.join(SCENES)}")
    return SCENES[name](shape, rng, reach)


def usaf_chart(
    shape: tuple[int, int], rng: Generator, reach: Reach | None = None, *, size: float | None = None
) -> Scene:
    """Draw a USAF-1951 chart: groups of six elements, each finer by 2^(1/6), dark bars on clear glass.

    An element is three horizontal and three vertical bars, five bar widths long, a bar width apart. Groups come in
    pairs around the next pair, a quarter of the size, down to bars of half a pixel; numbers are not drawn.

    Parameters
    ----------
    shape : (int, int)
        Of a frame.
    rng : numpy.random.Generator
        Not used: a chart is a chart.
    reach : (int, int, int, int), optional
        As in `make_scene`.
    size : float, optional
        Side of the chart in pixels; default 0.9 of the frame's shorter side.
    """
    image, origin = _blank(shape, 1.0, reach)
    size = size or 0.9 * min(shape)
    centre_x, centre_y = origin[0] + (shape[1] - 1) / 2, origin[1] + (shape[0] - 1) / 2
    _draw_group_pair(image, centre_x, centre_y, size / _PAIR_SIDE)
    light = (0.05 + 0.85 * np.clip(image, 0, 1)).astype(np.float32)
    return Scene(light.repeat(3, axis=2), origin)


# A pair of groups in bar widths of its coarsest element: its side, and the gap between elements.
_PAIR_SIDE = 26.0
_GAP = 1.5


def _draw_group_pair(image: NDArray[np.float32], x: float, y: float, width: float) -> None:
    """Draw groups g and g + 1 around (x, y); `width` is that of a bar of element 1 of group g, pixels."""
    if width < 0.5:
        return
    left, top = x - _PAIR_SIDE / 2 * width, y - _PAIR_SIDE / 2 * width
    right, bottom = x + _PAIR_SIDE / 2 * width, y + _PAIR_SIDE / 2 * width
    down = top
    for element in range(2, 7):  # group g, elements 2 to 6, down the left side
        bar = width * 2 ** (-(element - 1) / 6)
        _draw_element(image, left, down, bar)
        down += 5 * bar + _GAP * bar
    _draw_element(image, right - 12 * width, bottom - 5 * width, width)  # group g, element 1, bottom right
    down = top
    for element in range(1, 7):  # group g + 1 down the right side
        bar = width / 2 * 2 ** (-(element - 1) / 6)
        _draw_element(image, right - 12 * bar, down, bar)
        down += 5 * bar + _GAP * bar
    _draw_group_pair(image, x + 2 * width, y - 3 * width, width / 4)


def _draw_element(image: NDArray[np.float32], left: float, top: float, bar: float) -> None:
    """Draw three horizontal bars, then, two bar widths on, three vertical ones."""
    if bar < 0.5:
        return
    for index in (0, 2, 4):
        _darken(image, left, left + 5 * bar, top + index * bar, top + (index + 1) * bar)
        beside = left + 7 * bar
        _darken(image, beside + index * bar, beside + (index + 1) * bar, top, top + 5 * bar)


def _darken(image: NDArray[np.float32], left: float, right: float, top: float, bottom: float) -> None:
    """Take a rectangle's light away, pixel edges by the area they lose."""
    rows, columns = (
        np.clip(np.minimum(np.arange(length) + 0.5, stop) - np.maximum(np.arange(length) - 0.5, start), 0, 1)
        for length, start, stop in ((image.shape[0], top, bottom), (image.shape[1], left, right))
    )
    image[..., 0] -= np.outer(rows, columns).astype(np.float32)


def fibrous_tissue(
    shape: tuple[int, int], rng: Generator, reach: Reach | None = None, *, fibres: float = 0.004
) -> Scene:
    """Draw curved fibres of several widths and colours, bright on dark, `fibres` to a pixel of area."""
    image, origin = _blank(shape, 0.0, reach)
    height, width = image.shape[:2]
    glow = np.zeros((height, width, 3), np.float32)
    colours = np.array([[0.9, 0.5, 0.3], [0.5, 0.9, 0.5], [0.4, 0.6, 1.0]], np.float32)
    for thickness, colour in zip((0.8, 1.4, 2.6), colours, strict=True):
        count = max(1, round(fibres * height * width / (10 * thickness)))
        length = round(0.8 * min(shape))
        heading = rng.uniform(0, 2 * math.pi, (count, 1)) + np.cumsum(rng.normal(0, 0.06, (count, length)), axis=1)
        x = rng.uniform(0, width, (count, 1)) + np.cumsum(np.cos(heading), axis=1)
        y = rng.uniform(0, height, (count, 1)) + np.cumsum(np.sin(heading), axis=1)
        inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        places = np.rint(y[inside]).astype(int) * width + np.rint(x[inside]).astype(int)
        lines = np.bincount(places, minlength=height * width).reshape(height, width)
        glow += gaussian_filter(lines.astype(np.float32), thickness)[..., None] * thickness * colour
    return Scene((0.04 + 0.92 * (1 - np.exp(-1.6 * glow))).astype(np.float32), origin)


def fluorescent_cells(
    shape: tuple[int, int], rng: Generator, reach: Reach | None = None, *, cells: float = 0.0007
) -> Scene:
    """Draw bright cells on a dark ground, `cells` to a pixel of area: ellipses of three stains, some of which touch."""
    image, origin = _blank(shape, 0.0, reach)
    height, width = image.shape[:2]
    light = np.zeros((height, width, 3), np.float32)
    stains = np.array([[0.25, 1.0, 0.35], [1.0, 0.35, 0.2], [0.2, 0.45, 1.0]], np.float32)
    for _ in range(max(1, round(cells * height * width))):
        x, y, turn = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, math.pi)
        long, short = rng.uniform(8, 18), rng.uniform(6, 12)
        top, left = max(0, math.floor(y - 25)), max(0, math.floor(x - 25))
        part = light[top : math.ceil(y + 25), left : math.ceil(x + 25)]
        rows, columns = np.indices(part.shape[:2])
        down, along = rows + top - y, columns + left - x
        first, second = (
            along * math.cos(turn) + down * math.sin(turn),
            down * math.cos(turn) - along * math.sin(turn),
        )
        inside = 1 / (1 + np.exp(8 * (np.hypot(first / long, second / short) - 1)))
        stain = rng.uniform(0.35, 1.0) * stains[rng.integers(3)]
        np.maximum(part, inside[..., None] * stain, out=part)
    return Scene((0.002 + 0.95 * light).astype(np.float32), origin)


def _photograph(load: Callable[[], NDArray[np.uint8]]) -> "SceneMaker":
    def scene(shape: tuple[int, int], rng: Generator, reach: Reach | None = None) -> Scene:
        image = load()
        starts = [(have - want) / 2 for have, want in zip(image.shape[:2], shape, strict=True)]
        firsts = [max(0, math.floor(start - _MARGIN * want)) for start, want in zip(starts, shape, strict=True)]
        lasts = [math.ceil(start + (1 + _MARGIN) * want) for start, want in zip(starts, shape, strict=True)]
        if reach is not None:
            left, above, right, below = reach
            whole = above + shape[0] + below, left + shape[1] + right
            firsts = [(have - want) // 2 for have, want in zip(image.shape[:2], whole, strict=True)]
            if min(firsts) < 0:
                raise SettingsError(
                    f"the path needs {whole[0]} x {whole[1]} pixels of the scene, which has {image.shape[0]} x "
                    f"{image.shape[1]}; take fewer frames, smaller steps, or the scene 'slide', which has no end"
                )
            lasts = [first + want for first, want in zip(firsts, whole, strict=True)]
            starts = [firsts[0] + above, firsts[1] + left]
        part = image[firsts[0] : lasts[0], firsts[1] : lasts[1]]
        y0, x0 = (math.floor(start) - first for start, first in zip(starts, firsts, strict=True))
        return Scene(part.astype(np.float32) / np.float32(255), (x0, y0))

    return scene


def _blank(shape: tuple[int, int], value: float, reach: Reach | None) -> tuple[NDArray[np.float32], tuple[int, int]]:
    """Return an even one-channel image with room around a frame, and where the frame starts in it."""
    margin_y, margin_x = (math.ceil(_MARGIN * side) for side in shape)
    left, above, right, below = reach or (margin_x, margin_y, margin_x, margin_y)
    padded = (shape[0] + above + below, shape[1] + left + right, 1)
    if padded[0] * padded[1] > _MOST_PIXELS:
        if reach is None:
            raise SettingsError(
                f"frames of {shape[0]} x {shape[1]} pixels look at a scene too large to be drawn at once; take smaller "
                "frames, a photograph, or a scene of your own, which are reflected beyond their edges"
            )
        raise SettingsError(
            f"the path needs {padded[0]} x {padded[1]} pixels of the scene, too large to be drawn at once; take fewer "
            "frames, smaller steps, or the scene 'slide', which has no end"
        )
    return np.full(padded, value, np.float32), (left, above)


SceneMaker = Callable[[tuple[int, int], Generator, Reach | None], Scene]
SCENES: Mapping[str, SceneMaker] = {
    "histology": _photograph(skimage.data.immunohistochemistry),
    "retina": _photograph(skimage.data.retina),
    "usaf": usaf_chart,
    "tissue": fibrous_tissue,
    "cells": fluorescent_cells,
    "cat": _photograph(skimage.data.cat),
}
