"""What happens during a long recording: lost contact, cuts, light that drifts, bending tissue, cells that blink."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.simulation.motion import apply
from napari_fiberburst.simulation.paths import slow_change

# Waves that bend tissue, each way, and their lengths in parts of the frame's longer side.
_WAVES: Final = 3
_WAVELENGTHS = (1.5, 4.0)
# How far from the frame's middle a cell may lie where the probe passes it, in parts of the frame.
_CELL_PLACES: Final = 0.35
# Frames between a cell's flashes, on average.
_PAUSE: Final = 15


@dataclass(frozen=True, kw_only=True, eq=False)
class Bending:
    """Tissue that bends slowly: waves of displacement, each with a course of its own that starts at 0.

    Attributes
    ----------
    waves : numpy.ndarray
        (2, K, 3): of x and y, radians per pixel in x and in y, and the phase.
    courses : numpy.ndarray
        (T, 2, K) float32, pixels.
    """

    waves: NDArray[np.float64]
    courses: NDArray[np.float32]

    def at(self, number: int, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return how far the tissue at frame-0 points (..., 2) is displaced in a frame, (..., 2) in pixels."""
        parts = []
        for waves, course in zip(self.waves, self.courses[number], strict=True):
            phases = [(points @ wave[:2] + wave[2]).astype(np.float32) for wave in waves]
            parts.append(sum(size * np.cos(phase) for size, phase in zip(course, phases, strict=True)))
        return np.stack(parts, axis=-1).astype(np.float32)

    @cached_property
    def most(self) -> float:
        """Pixels by which nothing is displaced more on an axis."""
        return float(np.abs(self.courses).sum(axis=2).max())


@dataclass(frozen=True, kw_only=True, eq=False)
class Cells:
    """Cells that blink, as discs of light on the tissue, which move and bend with it.

    Attributes
    ----------
    places : numpy.ndarray
        (M, 2) as (x, y), frame-0 pixels.
    radius : float
        Pixels.
    traces : numpy.ndarray
        (T, M) float32: the light that each adds to the scene, in parts of full scale.
    """

    places: NDArray[np.float64]
    radius: float
    traces: NDArray[np.float32]

    def light(self, number: int, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the light (...) that the cells add in a frame at frame-0 points (..., 2)."""
        added = np.zeros(points.shape[:-1], np.float32)
        reach = self.radius + 1
        low, high = points.min(axis=tuple(range(points.ndim - 1))), points.max(axis=tuple(range(points.ndim - 1)))
        near = ((self.places >= low - reach) & (self.places <= high + reach)).all(axis=1)
        for cell in np.flatnonzero(near & (self.traces[number] > 0)):
            x, y = self.places[cell]
            distance = np.hypot(points[..., 0] - x, points[..., 1] - y)
            added += self.traces[number, cell] * np.clip(self.radius + 0.5 - distance, 0, 1).astype(np.float32)
        return added


def draw_lifts(frames: int, gaps: int, length: int, rng: Generator) -> NDArray[np.float32]:
    """Return how far the probe is off the tissue (T,): 0 in contact, 1 where no light comes back.

    One gap lies somewhere in each of as many equal parts of the recording, none in frame 0. The probe leaves within a
    third of a gap, and comes back within the last third.

    Raises
    ------
    SettingsError
        The gaps do not fit.
    """
    lifts = np.zeros(frames, np.float32)
    if gaps == 0:
        return lifts
    room = (frames - 1) // gaps
    if room <= length:
        raise SettingsError(
            f"{gaps} gaps of {length} frames and contact between them do not fit into {frames} frames; take fewer or "
            "shorter ones"
        )
    within = np.arange(1, length + 1)
    lift = np.minimum(1, np.minimum(within, within[::-1]) * 3 / (length + 1))
    for part in range(gaps):
        first = 1 + part * room + int(rng.integers(0, room - length + 1))
        lifts[first : first + length] = lift
    return lifts


def draw_cuts(frames: int, jumps: int, rng: Generator) -> NDArray[np.intp]:
    """Return the numbers of the frames that show another place than the one before, about evenly apart.

    Raises
    ------
    SettingsError
        There are not so many frames.
    """
    if jumps == 0:
        return np.zeros(0, np.intp)
    room = frames // (jumps + 1)
    if room < 2:
        raise SettingsError(f"{jumps} jumps do not fit into {frames} frames; take at most {max(0, frames // 2 - 1)}")
    late = rng.integers(-(room // 5), room // 5 + 1, jumps)
    cuts: NDArray[np.intp] = room * np.arange(1, jumps + 1) + late
    return cuts


def cut(
    homographies: NDArray[np.float64], cuts: NDArray[np.intp], distance: float, rng: Generator
) -> NDArray[np.float64]:
    """Return homographies (T, 3, 3) that go on from each cut at another place, so many pixels away."""
    angles = rng.uniform(0, 2 * math.pi, len(cuts))
    offsets = distance * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    moved = np.zeros((len(homographies), 3, 3)) + np.eye(3)
    for number, offset in zip(cuts, offsets, strict=True):
        moved[number:, :2, 2] += offset
    return moved @ homographies


def draw_exposures(frames: int, flicker: float, drift: float, rng: Generator) -> NDArray[np.float64]:
    """Return what the light of each frame is multiplied by (T,), geometric mean 1.

    Parameters
    ----------
    frames : int
        T.
    flicker : float
        Relative standard deviation from frame to frame.
    drift : float
        By how much the light changes at most over the recording, relative.
    rng : numpy.random.Generator
        Source of both.
    """
    flicker_rng, drift_rng = rng.spawn(2)
    logarithms = flicker_rng.normal(0, math.sqrt(math.log1p(flicker**2)), frames)
    logarithms += math.log1p(drift) * slow_change(frames, drift_rng)
    exposures: NDArray[np.float64] = np.exp(logarithms - logarithms.mean())
    return exposures


def draw_bending(frames: int, amount: float, shape: tuple[int, int], rng: Generator) -> Bending | None:
    """Return how tissue bends over a recording, None without: `amount` pixels root mean square where it is most."""
    if amount == 0:
        return None
    lengths = max(shape) * rng.uniform(*_WAVELENGTHS, (2, _WAVES))
    angles = rng.uniform(0, 2 * math.pi, (2, _WAVES))
    frequencies = 2 * math.pi / lengths
    waves = np.stack(
        [frequencies * np.cos(angles), frequencies * np.sin(angles), rng.uniform(0, 2 * math.pi, (2, _WAVES))], axis=-1
    )
    courses = np.stack([slow_change(frames, part) for part in rng.spawn(2 * _WAVES)], axis=1).reshape(frames, 2, _WAVES)
    # The mean square of a cosine is a half.
    spread = np.sqrt((courses**2).sum(axis=(1, 2)) / 2).max()
    courses *= amount / spread if spread > 0 else 0
    return Bending(waves=waves, courses=courses.astype(np.float32))


def draw_cells(
    count: int,
    homographies: NDArray[np.float64],
    shape: tuple[int, int],
    rng: Generator,
    *,
    radius: float,
    flash: float,
    length: int,
) -> Cells | None:
    """Return cells that the probe passes, and their flashes; None without.

    Parameters
    ----------
    count : int
        How many.
    homographies : numpy.ndarray
        (T, 3, 3), frame-t pixel to frame-0 pixel.
    shape : (int, int)
        Height and width of a frame.
    rng : numpy.random.Generator
        Source of places and times.
    radius : float
        Of a cell, pixels.
    flash : float
        Light of a flash, in parts of full scale.
    length : int
        Frames of a flash.
    """
    if count == 0:
        return None
    place_rng, time_rng = rng.spawn(2)
    frames = len(homographies)
    size = np.array([shape[1], shape[0]])
    pixels = (size - 1) / 2 + size * place_rng.uniform(-_CELL_PLACES, _CELL_PLACES, (count, 2))
    passing = place_rng.integers(0, frames, count)
    places = [apply(homographies[number], pixel) for number, pixel in zip(passing, pixels, strict=True)]
    traces = np.zeros((frames, count), np.float32)
    for trace in traces.T:
        most = frames // (length + 1) + 1
        starts = np.cumsum(length + time_rng.geometric(1 / _PAUSE, most)) - length
        for late in range(length):
            shown = starts + late
            trace[shown[shown < frames]] = flash
    return Cells(places=np.array(places), radius=radius, traces=traces)
