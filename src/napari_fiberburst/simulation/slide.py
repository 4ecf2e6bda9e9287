"""A stained slide without end: drawn where it is looked at, the same wherever one comes from."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array

from napari_fiberburst.errors import SettingsError

# Side of the squares in which a slide is drawn, pixels, and how many are kept.
_TILE: Final = 128
_TILES_KEPT: Final = 64
# Around a square, as far as a nucleus reaches into it.
_MARGIN: Final = 12
_SPLINE_ORDER: Final = 2
# Spacings of the noise that makes tissue uneven, pixels, and how much of it there is at each: as in photographs of
# tissue, the amplitude grows with the spacing, and the finest is under a core's pitch.
_SPACINGS: Final = (2, 4, 8, 16, 32, 64, 128, 256)
_ROUGHNESS: Final = 0.4
# Spacing of what makes glands and their lumina, pixels.
_GLAND: Final = 44
# A fibre's thickness and length, pixels.
_FIBRE: Final = (5, 32)
# A nucleus at most in each square of this side, pixels; the shorter radius of one, and how much longer it is.
_NUCLEUS_ROOM: Final = 8
_NUCLEUS_RADII, _NUCLEUS_STRETCH = (1.6, 4.2), (1.0, 1.8)
# Optical densities in red, green and blue of what stains nuclei and what stains the rest.
_HAEMATOXYLIN = np.array([0.65, 0.70, 0.29], np.float32)
_EOSIN = np.array([0.07, 0.99, 0.11], np.float32)
# Light where nothing is stained, and where all is, in fluorescence.
_CLEAR, _GLOW = 0.95, 0.5


@dataclass(frozen=True)
class Slide:
    """Tissue in two stains: glands around lumina, fibres between them, nuclei of varied size and stain.

    Detail is at all scales from 256 pixels down to 2, and no place is like another. It needs no more memory for a large
    field than for a small one.

    Parameters
    ----------
    seed : int
        Another one gives other tissue.
    channels : int
        3 are red, green and blue, 1 is their mean; others are bands spread over that spectrum.
    glows : bool
        The stains shine on black, as in fluorescence, and leave room for cells that flash; otherwise they take light
        away from white.
    """

    seed: int = 0
    channels: int = 3
    glows: bool = False

    def __post_init__(self) -> None:
        if self.seed < 0 or self.channels < 1:
            raise SettingsError(f"a slide has a seed of at least 0 and at least 1 channel; got {self}")

    def with_channels(self, channels: int) -> "Slide":
        """Return the same tissue in another number of channels."""
        return replace(self, channels=channels)

    def sample(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the slide (..., C) at frame-0 points (..., 2)."""
        if points.size == 0:
            return np.zeros((*points.shape[:-1], self.channels), np.float32)
        x, y = points[..., 0], points[..., 1]
        left, top = math.floor(x.min()) - _SPLINE_ORDER, math.floor(y.min()) - _SPLINE_ORDER
        right, bottom = math.ceil(x.max()) + _SPLINE_ORDER, math.ceil(y.max()) + _SPLINE_ORDER
        drawn = self._drawn(left, top, right + 1, bottom + 1)
        bands = [
            map_coordinates(band, (y - top, x - left), order=_SPLINE_ORDER, prefilter=False, output=np.float32)
            for band in drawn
        ]
        return np.stack(bands, axis=-1)

    def _drawn(self, left: int, top: int, right: int, bottom: int) -> NDArray[np.float32]:
        """Return the spline coefficients (C, H, W) of the columns [left, right) and rows [top, bottom)."""
        drawn = np.empty((self.channels, bottom - top, right - left), np.float32)
        for row in range(top // _TILE, (bottom - 1) // _TILE + 1):
            for column in range(left // _TILE, (right - 1) // _TILE + 1):
                y0, x0 = row * _TILE, column * _TILE
                rows = slice(max(top, y0), min(bottom, y0 + _TILE))
                columns = slice(max(left, x0), min(right, x0 + _TILE))
                part = _tile(self, column, row)[
                    :, rows.start - y0 : rows.stop - y0, columns.start - x0 : columns.stop - x0
                ]
                drawn[:, rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = part
        return drawn


@lru_cache(maxsize=_TILES_KEPT)
def _tile(slide: Slide, column: int, row: int) -> NDArray[np.float32]:
    """Return a square of a slide, (C, 128, 128)."""
    ground = _Ground(slide.seed, column * _TILE - _MARGIN, row * _TILE - _MARGIN, _TILE + 2 * _MARGIN)
    gland = ground.noise(1, _GLAND, _GLAND) + 0.25 * ground.noise(2, _GLAND // 4, _GLAND // 4)
    uneven = sum(
        (spacing / _SPACINGS[-1]) ** _ROUGHNESS * ground.noise(10 + number, spacing, spacing)
        for number, spacing in enumerate(_SPACINGS)
    )
    lumen = _step((gland - 1.05) / 0.08)
    wall = _step((gland - 0.25) / 0.1) * (1 - lumen)
    stroma = 1 - lumen - wall
    eosin = (0.35 * wall + 0.28 * stroma + 0.02 * lumen) * np.exp(0.45 * uneven) + 0.5 * stroma * _fibres(ground)
    chromatin = np.exp(0.5 * ground.noise(30, 2, 2))
    haematoxylin = 0.06 * (1 - lumen) + _nuclei(ground, wall, stroma) * chromatin
    density = haematoxylin[None] * _HAEMATOXYLIN[:, None, None] + eosin[None] * _EOSIN[:, None, None]
    passed = np.exp(-density)[:, _MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
    light = _GLOW * (1 - passed) if slide.glows else _CLEAR * passed
    positions = np.linspace(0, 2, slide.channels)
    mixing = np.array([np.interp(positions, range(3), band) for band in np.eye(3)], np.float32)
    if slide.channels == 1:
        mixing = np.full((3, 1), 1 / 3, np.float32)
    mixed: NDArray[np.float32] = np.ascontiguousarray(np.einsum("cyx,cd->dyx", light, mixing))
    return mixed


def _fibres(ground: "_Ground") -> NDArray[np.float32]:
    """Return fine curved lines (H, W), about 1 on a line: level lines of noise that is longer than it is thick."""
    thick, long = _FIBRE
    bent = 1.5 * ground.noise(5, long, long)
    flat, steep = ground.noise(3, long, thick) + bent, ground.noise(4, thick, long) + bent
    is_flat = _step(ground.noise(6, 3 * long, 3 * long) / 0.3)
    lines: NDArray[np.float32] = is_flat * np.exp(-((flat / 0.2) ** 2)) + (1 - is_flat) * np.exp(-((steep / 0.2) ** 2))
    return lines


def _nuclei(ground: "_Ground", wall: NDArray[np.float32], stroma: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return how dark nuclei are stained (H, W): dense in a gland's wall, sparse between glands, none in a lumen."""
    size = ground.size
    columns, rows = ground.lattice(_NUCLEUS_ROOM, _NUCLEUS_ROOM)
    chance = [_uniform(ground.seed, 40 + number, columns, rows).astype(np.float32) for number in range(7)]
    x = columns * _NUCLEUS_ROOM - ground.left + _NUCLEUS_ROOM * chance[0]
    y = rows * _NUCLEUS_ROOM - ground.top + _NUCLEUS_ROOM * chance[1]
    at = np.clip(np.rint(y).astype(int), 0, size - 1), np.clip(np.rint(x).astype(int), 0, size - 1)
    there = chance[2] < 0.9 * wall[at] + 0.25 * stroma[at]
    x, y = x[there].astype(np.float32), y[there].astype(np.float32)
    radius = (_NUCLEUS_RADII[0] + (_NUCLEUS_RADII[1] - _NUCLEUS_RADII[0]) * chance[3][there])[:, None, None]
    stretch = (_NUCLEUS_STRETCH[0] + (_NUCLEUS_STRETCH[1] - _NUCLEUS_STRETCH[0]) * chance[4][there])[:, None, None]
    angle = (math.pi * chance[5][there])[:, None, None]
    stain = (0.35 + 0.9 * chance[6][there])[:, None, None]
    offsets = np.arange(-_MARGIN + 2, _MARGIN - 1, dtype=np.int32)
    columns = np.rint(x).astype(np.int32)[:, None, None] + offsets[None, None, :]
    rows = np.rint(y).astype(np.int32)[:, None, None] + offsets[None, :, None]
    across, down = (columns - x[:, None, None]).astype(np.float32), (rows - y[:, None, None]).astype(np.float32)
    along = (np.cos(angle) * across + np.sin(angle) * down) / stretch
    beside = np.cos(angle) * down - np.sin(angle) * across
    depth = stain * np.clip(radius + 0.5 - np.hypot(along, beside), 0, 1)
    inside = (depth > 0) & (columns >= 0) & (columns < size) & (rows >= 0) & (rows < size)
    stained = np.zeros(size * size, np.float32)
    np.maximum.at(stained, (rows * size + columns)[inside], depth[inside])
    return stained.reshape(size, size)


@dataclass(frozen=True)
class _Ground:
    """Noise on a square of the plane, that fits to the noise on the next."""

    seed: int
    left: int
    top: int
    size: int

    def lattice(self, across: int, down: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return columns and rows (M,) of a lattice of these spacings, whose points touch the square."""
        columns = np.arange(self.left // across - 2, (self.left + self.size) // across + 3)
        rows = np.arange(self.top // down - 2, (self.top + self.size) // down + 3)
        grid = np.meshgrid(columns, rows)
        return grid[0].ravel(), grid[1].ravel()

    def noise(self, kind: int, across: int, down: int) -> NDArray[np.float32]:
        """Return smooth noise (H, W) of these spacings in pixels, and of about standard deviation 1."""
        over_x, over_y = _basis(self.left, self.size, across), _basis(self.top, self.size, down)
        columns, rows = self.lattice(across, down)
        values = (math.sqrt(12) * (_uniform(self.seed, kind, columns, rows) - 0.5)).astype(np.float32)
        # Sparse, because a dense product's last bit may depend on the number of threads.
        smooth: NDArray[np.float32] = (over_x @ (over_y @ values.reshape(over_y.shape[1], -1)).T).T
        return smooth / np.float32(0.48)  # a bicubic B-spline leaves this much of white noise's standard deviation


@lru_cache(maxsize=256)
def _basis(first: int, size: int, spacing: int) -> csr_array:
    """Return what cubic B-splines at a lattice's points come to at pixels, (size, M)."""
    low = first // spacing - 2
    count = (first + size) // spacing + 3 - low
    place, part = np.divmod(np.arange(first, first + size), spacing)
    t = part / spacing
    weights = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=1) / 6
    columns = place[:, None] - low + np.arange(-1, 3)
    pixels = np.repeat(np.arange(size), 4)
    return csr_array((weights.ravel().astype(np.float32), (pixels, columns.ravel())), shape=(size, count))


def _uniform(seed: int, kind: int, columns: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return a number in [0, 1) for every point of a lattice: its coordinates mixed as splitmix64 does."""
    mixed = np.full(columns.shape, seed, np.uint64)
    for value in (np.uint64(kind), columns.astype(np.uint64), rows.astype(np.uint64)):
        mixed = (mixed ^ value) + np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53


def _step(value: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return a smooth step from 0 to 1."""
    step: NDArray[np.floating] = 0.5 * (1 + np.tanh(value))
    return step.astype(np.float32, copy=False)
