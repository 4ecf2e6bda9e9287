"""Where a probe goes in a long recording, frame by frame, and by how much it turns on the way."""

import math
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from napari_fiberburst.simulation.motion import compose

# From one row of a raster, or turn of a spiral, to the next, in parts of a frame: neighbours overlap by two fifths.
_BETWEEN: Final = 0.6
# A hand's circles: their radius in parts of the frame's shorter side, and which part of the speed goes into them.
_CIRCLES, _CIRCLING = 0.45, 0.8
# How often a hand comes by a place, on average.
_VISITS: Final = 2.0
# A hand's tremor, in parts of the way from frame to frame, and the frames over which it holds its course.
_TREMOR, _TREMOR_FRAMES = 0.1, 2.0
# The standard deviation of a cubic B-spline with random coefficients, and that of its slope, in those of coefficients.
_SPLINE_SPREAD, _SPLINE_SLOPE = math.sqrt(151 / 315), math.sqrt(2 / 3)
# Into how many parts a recording falls, in each of which turn and zoom go one way.
_SWAYS: Final = 6
_NEWTON_STEPS: Final = 20


def raster_path(frames: int, shape: tuple[int, int], rng: Generator, step: float) -> NDArray[np.float64]:
    """Return positions (T, 2) on rows, there and back, as far apart as the next row still overlaps.

    Parameters
    ----------
    frames : int
        T.
    shape : (int, int)
        Height and width of a frame.
    rng : numpy.random.Generator
        Not used: a stage goes where it is told.
    step : float
        Pixels along the path from frame to frame.
    """
    down = _BETWEEN * shape[0]
    whole = step * (frames - 1)
    rows = max(1, round((math.sqrt(1 + 4 * whole / down) - 1) / 2))  # so that the field becomes about square
    across = (whole - (rows - 1) * down) / rows
    row, along = np.divmod(step * np.arange(frames), max(across + down, 1e-9))
    x = np.minimum(along, across)
    x = np.where(row % 2 == 0, x, across - x)
    return np.stack([x, row * down + np.maximum(along - across, 0)], axis=1)


def spiral_path(frames: int, shape: tuple[int, int], rng: Generator, step: float) -> NDArray[np.float64]:
    """Return positions (T, 2) on a spiral outwards, whose turns overlap; parameters as in `raster_path`."""
    widening = _BETWEEN * min(shape) / (2 * math.pi)
    length = step * np.arange(frames)
    angle = np.sqrt(2 * length / widening)
    for _ in range(_NEWTON_STEPS):
        slope = np.hypot(1, angle)
        angle -= (0.5 * (angle * slope + np.arcsinh(angle)) - length / widening) / slope
    path: NDArray[np.float64] = widening * angle[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return path


def handheld_path(frames: int, shape: tuple[int, int], rng: Generator, step: float) -> NDArray[np.float64]:
    """Return positions (T, 2) of a hand that wanders in circles and crosses its own path time and again.

    Parameters
    ----------
    frames, shape
        As in `raster_path`.
    rng : numpy.random.Generator
        Source of the path.
    step : float
        Pixels from frame to frame, root mean square.
    """
    side = min(shape)
    radius = _CIRCLES * side
    phase = rng.uniform(0, 2 * math.pi) + math.sqrt(_CIRCLING) * step / radius * np.arange(frames)
    circles = radius * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    spread = max(math.sqrt(frames * step * side / _VISITS) / 3, radius / 2)
    speed = math.sqrt((1 - _CIRCLING) / 2) * step
    drift = spread * _wander(frames, spread / _SPLINE_SPREAD * _SPLINE_SLOPE / max(speed, 1e-9), rng)
    path: NDArray[np.float64] = circles + drift + _TREMOR * step * _wander(frames, _TREMOR_FRAMES, rng)
    return path


PATHS: Mapping[str, Callable[[int, tuple[int, int], Generator, float], NDArray[np.float64]]] = {
    "raster": raster_path,
    "spiral": spiral_path,
    "handheld": handheld_path,
}


def follow(
    path: str,
    frames: int,
    shape: tuple[int, int],
    rng: Generator,
    *,
    step: float,
    laps: int = 1,
    turn: float = 0.0,
    zoom: float = 0.0,
) -> NDArray[np.float64]:
    """Return homographies (T, 3, 3), frame-t pixel to frame-0 pixel, of a probe on a path.

    Parameters
    ----------
    path : str
        One of `PATHS`.
    frames : int
        T.
    shape : (int, int)
        Height and width of a frame.
    rng : numpy.random.Generator
        Source of all that is irregular.
    step : float
        Pixels from frame to frame.
    laps : int
        How many times the path is gone: forth, back, forth and so on.
    turn : float
        Degrees by which the probe turns at most, slowly, and over all laps.
    zoom : float
        The same of its magnification, relative.
    """
    path_rng, turn_rng, zoom_rng = rng.spawn(3)
    once = math.ceil(frames / laps)
    lap, place = np.divmod(np.arange(frames), once)
    place = np.where(lap % 2 == 0, place, once - 1 - place)
    positions = PATHS[path](once, shape, path_rng, step)
    x, y = (positions - positions[0])[place].T
    rotation = math.radians(turn) * slow_change(frames, turn_rng)
    log_scale = math.log1p(zoom) * slow_change(frames, zoom_rng)
    level = np.zeros(frames)
    return compose(shape, x, y, rotation, log_scale, level, level)


def slow_change(frames: int, rng: Generator) -> NDArray[np.float64]:
    """Return a smooth course (T,) that starts at 0 and goes as far as 1 or -1 at most."""
    course = _wander(frames, frames / _SWAYS, rng)[:, 0]
    course -= course[0]
    most = np.abs(course).max()
    changed: NDArray[np.float64] = course / most if most > 0 else course
    return changed


def _wander(frames: int, hold: float, rng: Generator) -> NDArray[np.float64]:
    """Return a smooth random walk (T, 2) around 0, of standard deviation 1, that holds its course for `hold` frames."""
    count = math.ceil((frames - 1) / hold) + 4
    curve = BSpline(np.arange(-3.0, count + 1), rng.standard_normal((count, 2)) / _SPLINE_SPREAD, 3)
    walk: NDArray[np.float64] = curve(np.arange(frames) / hold)
    return walk
