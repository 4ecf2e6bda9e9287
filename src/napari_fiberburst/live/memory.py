"""What the cores have seen so far, as normal equations that take frames in and forget old ones.

The unknown is the scene as cores see it, through their footprint: a linear spline b, which solves

    (S^T W S + mu P) b = S^T W v

with the membrane prior P. Without the footprint in it, all is local: each node is tied to its eight neighbours alone,
and a step of conjugate gradients is one pass over the nodes. The footprint is undone once a picture (`sharpening`).

Forgetting multiplies all that is there by a number below 1 with each frame. Instead, each new frame is given as much
more weight, which touches only what it adds; now and then everything is brought back to scale.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.ndimage import map_coordinates

from napari_fiberburst.live.compiled import compiled
from napari_fiberburst.live.cores import Cores
from napari_fiberburst.live.nodes import Nodes
from napari_fiberburst.live.pose import Pose
from napari_fiberburst.live.solving import BANDS, multiply, solve
from napari_fiberburst.operators.filters import filled_mean

Floats = NDArray[np.float32]

# mu, in samples of weight 1 to a node. It holds the scene together between samples; how smooth the picture is, is
# decided when the footprint is undone.
TIE = 0.03
# Weights are brought back to scale before they have grown by this much.
_MOST_GROWTH = 1e4
# Nodes are as many pixels apart as is below this part of the footprint's radius: it lets no finer waves through.
_SPACINGS, _FINEST = (2.0, 1.5, 1.0), 0.87
# Pixels about the frame's that are solved with them, in pitches, and those that it may move over beyond.
_MARGIN, _SLACK = 1.0, 7


class Memory:
    """The normal equations about the newest frame, and their solution.

    Parameters
    ----------
    shape : (int, int)
        Height and width of a frame, pixels.
    pitch, radius : float
        Distance of neighbouring cores, and radius of their footprint, pixels.
    area : float
        Pixels of a frame that show the object.
    channels : int
        Of the frames.
    """

    def __init__(self, shape: tuple[int, int], pitch: float, radius: float, area: float, channels: int) -> None:
        self._margin = _MARGIN * pitch + 2
        spacing = next((one for one in _SPACINGS if one <= _FINEST * radius), 1.0)
        rows, columns = (_count((side + 2 * (self._margin + _SLACK)) / spacing) for side in shape)
        self.nodes = Nodes(0, 0, rows, columns, spacing).about(complex(shape[1] - 1, shape[0] - 1) / 2)
        self._area = area
        self._spare = np.zeros((3, rows, columns), np.float32)
        self.clear(channels)

    def clear(self, channels: int) -> None:
        """Forget everything."""
        self._growth, self._total = 1.0, 0.0
        self._planes = np.zeros((BANDS + channels, self.nodes.rows, self.nodes.columns), np.float32)
        self._other_planes = np.empty_like(self._planes)  # to move them into
        self.scene = np.zeros((channels, self.nodes.rows, self.nodes.columns), np.float32)

    @property
    def density(self) -> float:
        """Weight of samples to a pixel that shows the object, in frames that count as the newest one does."""
        return self._total / self._growth

    @property
    def seen(self) -> Floats:
        """How much each node has been seen, (rows, columns), in units of `growth`: the diagonal without the prior."""
        seen: Floats = self._planes[0]
        return seen

    @property
    def growth(self) -> float:
        """The weight of a sample of the newest frame."""
        return self._growth

    def centre_on(self, low: complex, high: complex) -> None:
        """Move the nodes so that a frame from one corner to the other lies well inside; what falls out is forgotten."""
        if self.nodes.holds(low, high, self._margin):
            return
        old, self.nodes = self.nodes, self.nodes.about((low + high) / 2)
        before, self._planes, self._other_planes = self._planes, self._other_planes, self._planes
        there_y, here_y = _overlap(old.row, self.nodes.row, old.rows)
        there_x, here_x = _overlap(old.column, self.nodes.column, old.columns)
        self._planes.fill(0)
        self._planes[:, here_y, here_x] = before[:, there_y, there_x]
        self._close()
        along_y, along_x = (
            (np.arange(count) + new - start).clip(0, count - 1)
            for count, new, start in (
                (old.rows, self.nodes.row, old.row),
                (old.columns, self.nodes.column, old.column),
            )
        )
        self.scene = np.ascontiguousarray(self.scene[:, along_y[:, None], along_x])

    def turn_to(self, pose: Pose) -> None:
        """Let nodes lie upright in a frame that lies so, and carry over what was seen.

        Each node has seen what the scene shows there, with the weight of the samples about it, because what they couple
        does not turn with them.
        """
        old, self.nodes = self.nodes, self.nodes.about(pose.middle)
        columns, rows = (
            (first + np.arange(count)) * old.spacing
            for first, count in ((self.nodes.column, old.columns), (self.nodes.row, old.rows))
        )
        there = (pose.points(columns + 1j * rows[:, None]) - old.origin) / old.spacing
        places = np.stack([there.imag, there.real])
        weight = map_coordinates(self._row_sums(), places, order=1) / self._growth
        self.scene = np.stack([map_coordinates(scene, places, order=3, mode="nearest") for scene in self.scene])
        self._total, self._growth = self.density, 1.0
        self._planes.fill(0)
        self._planes[0] = np.maximum(weight, 0)
        self._planes[BANDS:] = self._planes[0] * self.scene
        self._close()

    def forget(self, kept: float) -> None:
        """Keep this part, 0 to 1, of the weight of all that was seen."""
        self._growth /= kept
        if self._growth > _MOST_GROWTH:
            self._planes /= np.float32(self._growth)
            self._total /= self._growth
            self._growth = 1.0

    def add(self, cores: Cores, pose: Pose, values: Floats, weights: Floats) -> None:
        """Take in what the cores of a frame that lies so show: values (N, C) and weights (N,)."""
        weights = np.asarray(weights * np.float32(self._growth), np.float32)
        self._total += _add(self._planes, cores.x, cores.y, *self.nodes.under(pose), values, weights) / self._area

    def start(self, width: float) -> None:
        """Let the scene be the local mean of what was seen, over a Gaussian of so many pixels: to begin with."""
        mass, totals = torch.from_numpy(self._row_sums()), torch.from_numpy(self._planes[BANDS:])
        self.scene = filled_mean(totals, mass, width / self.nodes.spacing).numpy()

    def solve(self, iterations: int) -> None:
        """Take so many steps of conjugate gradients from the scene as it stands, (C, rows, columns)."""
        solve(self._planes, np.float32(TIE * self._growth), self.scene, self._spare, iterations)

    def _row_sums(self) -> Floats:
        """Return what the matrix without its prior does to an even image of ones, (rows, columns)."""
        sums, ones = np.zeros(self._planes.shape[1:], np.float32), np.ones(self._planes.shape[1:], np.float32)
        multiply(self._planes, np.float32(0), ones, sums)
        return sums

    def _close(self) -> None:
        """Cut what couples nodes to the ring, as if the scene were even there."""
        before, planes = self._row_sums(), self._planes
        planes[:, [0, -1]] = planes[:, :, [0, -1]] = 0
        planes[2:BANDS, -2] = planes[[1, 3], :, -2] = planes[4, :, 1] = 0
        planes[0] += before - self._row_sums()
        planes[0, [0, -1]] = planes[0, :, [0, -1]] = 0


@compiled("f8(f4[:,:,::1], f4[::1], f4[::1], f8, f8, f8, f8, f4[:,::1], f4[::1])")
def _add(planes: Floats, x: Floats, y: Floats, u: Any, v: Any, a: Any, b: Any, values: Floats, weights: Floats) -> Any:
    """Add samples to the normal equations, and return the weight of those that lie on the nodes within the ring."""
    rows, columns = planes.shape[1:]
    flat = planes.reshape(-1)
    one, step, size = np.uint64(1), np.uint64(columns), np.uint64(rows * columns)  # unsigned: no negative indices
    total = 0.0
    for core in range(len(x)):
        weight = weights[core]
        across, down = u + a * x[core] - b * y[core], v + b * x[core] + a * y[core]
        if not (weight > 0 and 1 <= across < columns - 2 and 1 <= down < rows - 2):
            continue
        i, j = np.int32(down), np.int32(across)
        right, below = np.float32(across - j), np.float32(down - i)
        left, above = np.float32(1) - right, np.float32(1) - below
        p, q, r, s = left * above, right * above, left * below, right * below
        wp, wq, wr, ws = weight * p, weight * q, weight * r, weight * s
        at = np.uint64(i) * step + np.uint64(j)
        flat[at] += wp * p
        flat[at + one] += wq * q
        flat[at + step] += wr * r
        flat[at + step + one] += ws * s
        at += size
        flat[at] += wp * q
        flat[at + step] += wr * s
        at += size
        flat[at] += wp * r
        flat[at + one] += wq * s
        at += size
        flat[at] += wp * s
        at += size
        flat[at + one] += wq * r
        for channel in range(values.shape[1]):
            at += size
            value = values[core, channel]
            flat[at] += wp * value
            flat[at + one] += wq * value
            flat[at + step] += wr * value
            flat[at + step + one] += ws * value
        total += weight
    return total


def _count(least: float) -> int:
    """Return how many nodes at least, so that they and the pixels under them are quick to transform."""
    return 2 * int(next_fast_len(int(np.ceil(least / 2)), real=True))


def _overlap(old: int, new: int, count: int) -> tuple[slice, slice]:
    """Return which of `count` nodes from `old` on are among as many from `new` on, there and here; none, maybe."""
    first, last = max(old, new), max(max(old, new), min(old, new) + count)
    return slice(first - old, last - old), slice(first - new, last - new)
