"""Where the newest frame lies: found coarsely beside the last one, then fitted to the scene as it stands."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from napari_fiberburst.live.nodes import Nodes
from napari_fiberburst.live.pose import Pose

Floats = NDArray[np.float32]

# A cell of the small images, pitches, and over how many cells they are evened out.
_CELL, _EVENED = 0.8, 9
# Frames must have this part of the field in common.
_LEAST_OVERLAP = 0.25
# Iterations of Gauss-Newton; those before the last few use a part of the cores.
_ITERATIONS, _ON_ALL, _PART = 6, 3, 4
# Residuals beyond so many times their median count less (Huber).
_ROBUST = 3.0
# Pixels: a step that moves no corner farther ends the fit.
_SETTLED = 2e-3
# Nodes with less than this weight have not been seen.
_LEAST_WEIGHT = 1e-3


class Finder:
    """Finds how far one frame lies from another by small images of both.

    Parameters
    ----------
    positions : numpy.ndarray
        (N, 2) of the cores, pixels.
    shape : (int, int)
        Height and width of a frame.
    pitch : float
        Distance of neighbouring cores, pixels.
    """

    def __init__(self, positions: NDArray[np.float64], shape: tuple[int, int], pitch: float) -> None:
        self._cell = _CELL * pitch
        rows, columns = (int(np.ceil(side / self._cell)) for side in shape)
        y, x = np.indices((rows, columns))
        cells = (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) * self._cell - 0.5
        distance, number = cKDTree(positions).query(cells, k=3, distance_upper_bound=1.5 * pitch)
        near = np.isfinite(distance)
        weight = np.where(near, np.exp(-((np.where(near, distance, 0) / pitch) ** 2)), 0)
        weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
        row, column = np.nonzero(near)
        entries = (weight[near].astype(np.float32), (row, np.asarray(number)[row, column]))
        self._read = csr_array(entries, shape=(len(cells), len(positions)))
        self._size = rows, columns
        self._known = near.any(axis=1).reshape(rows, columns).astype(np.float32)
        self._mass = np.maximum(uniform_filter(self._known, _EVENED), 1e-3)
        self._padded = tuple(int(next_fast_len(2 * side, real=True)) for side in self._size)
        mask = rfft2(self._known, s=self._padded)
        overlap = irfft2(mask.conj() * mask, s=self._padded) / max(float(self._known.sum()), 1.0)
        self._scale = np.where(overlap > _LEAST_OVERLAP, 1 / np.maximum(overlap, _LEAST_OVERLAP) ** 0.75, 0)

    def spectrum(self, grey: Floats) -> NDArray[np.complex64]:
        """Return the spectrum of the small image of a frame's light (N,)."""
        image: Floats = np.asarray(self._read @ grey, np.float32).reshape(self._size)
        image = np.asarray(image - uniform_filter(image, _EVENED) / self._mass, np.float32) * self._known
        image = gaussian_filter(image, 0.7)
        power = float(np.sqrt((image**2).sum()))
        spectrum: NDArray[np.complex64] = rfft2(image / max(power, 1e-9), s=self._padded)
        return spectrum

    def shift(self, first: NDArray[np.complex64], second: NDArray[np.complex64]) -> tuple[complex, float]:
        """Return the shift (x + i y, pixels) that takes points of the second image to the first, and its score."""
        score = irfft2(second.conj() * first, s=self._padded) * self._scale
        place = divmod(int(score.argmax()), score.shape[1])
        y, x = (int(at) - (side if at > side // 2 else 0) for at, side in zip(place, self._padded, strict=True))
        finer = complex(_peak(score[place[0]], place[1]), _peak(score[:, place[1]], place[0]))
        return (complex(x, y) + finer) * self._cell, float(score[place])


def _peak(line: Floats, place: int) -> float:
    """Return how far beyond a highest value, -0.5 to 0.5, a parabola through its neighbours has its peak."""
    before, at, after = line[place - 1], line[place], line[(place + 1) % len(line)]
    bend = before - 2 * at + after
    return float(np.clip((before - after) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0


@dataclass(frozen=True, slots=True)
class Fit:
    """How a frame lies on the scene.

    Attributes
    ----------
    pose : Pose
        Where.
    brightness : float
        Of the frame, relative to the scene.
    alike : float
        Correlation of the cores' light with what the scene has there, 0 to 1.
    """

    pose: Pose
    brightness: float
    alike: float


def fit(
    grey: Floats,
    weights: Floats,
    positions: NDArray[np.complex128],
    scene: Floats,
    seen: Floats,
    nodes: Nodes,
    pose: Pose,
    *,
    turns: bool,
) -> Fit:
    """Fit pose and brightness of a frame to the scene as cores see it, by Gauss-Newton.

    Parameters
    ----------
    grey, weights : numpy.ndarray
        (N,), what its cores show.
    positions : numpy.ndarray
        (N,), where they are, x + i y.
    scene, seen : numpy.ndarray
        (rows, columns), the scene, and how much each node has been seen.
    nodes : Nodes
        Of both.
    pose : Pose
        Where to start.
    turns : bool
        Whether the frame may have turned and grown since; otherwise it is only shifted.
    """
    brightness = 1.0
    for number in range(_ITERATIONS):
        some = slice(None) if number >= _ITERATIONS - _ON_ALL else slice(None, None, _PART)
        corners = nodes.corners(pose.points(positions[some]))
        light, along_x, along_y = corners.read_with_slopes(scene)
        used = corners.inside & (corners.read(seen) > _LEAST_WEIGHT)
        weight = np.asarray(weights[some] * used, np.float32)
        if not weight.any():
            return Fit(pose, 1.0, 0.0)
        if number == 0:
            brightness = float((weight * light * grey[some]).sum() / max((weight * light**2).sum(), 1e-9))
        left = grey[some] - np.float32(brightness) * light
        usual = float(np.median(np.abs(left[weight > 0]))) + 1e-6
        weight = np.asarray(weight / np.maximum(1, np.abs(left) / np.float32(_ROBUST * usual)), np.float32)
        away = (positions[some] - pose.middle) * pose.turn
        x, y = away.real.astype(np.float32), away.imag.astype(np.float32)
        slopes = np.stack([along_x, along_y, along_x * x + along_y * y, along_y * x - along_x * y])
        jacobian = np.concatenate([slopes * np.float32(brightness), light[None]])
        if not turns:
            jacobian[2:4] = 0
        weighted = jacobian * weight
        normal = (weighted @ jacobian.T).astype(np.float64)
        scale = np.sqrt(normal.diagonal()) + 1e-12
        step = np.linalg.solve(normal / np.outer(scale, scale) + 1e-6 * np.eye(5), weighted @ left / scale) / scale
        pose = pose.moved(complex(step[0], step[1]), 1 + complex(step[2], step[3]))
        brightness += float(step[4])
        is_on_all = number >= _ITERATIONS - _ON_ALL
        if is_on_all and max(np.hypot(*step[:2]), np.hypot(*step[2:4]) * abs(pose.middle)) < _SETTLED:
            break
    return Fit(pose, brightness, _correlation(grey[some], light, weight))


def _correlation(first: Floats, second: Floats, weight: Floats) -> float:
    total = float(weight.sum())
    first, second = (np.asarray(part - (weight * part).sum() / total, np.float32) for part in (first, second))
    power = float((weight * first**2).sum() * (weight * second**2).sum())
    return max(0.0, float((weight * first * second).sum()) / power**0.5) if power > 0 else 0.0
