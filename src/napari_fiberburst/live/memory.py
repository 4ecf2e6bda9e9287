"""What the cores have seen so far, as normal equations that take frames in and forget old ones.

The unknown is the scene as cores see it, through their footprint: a linear spline b on nodes a pixel apart, which
solves

    (S^T W S + mu P) b = S^T W v

with the membrane prior P. Without the footprint in it, all is local: each node is tied to its eight neighbours alone,
and a step of conjugate gradients is one pass over the nodes. The footprint is undone once a picture (`sharpening`).

Forgetting multiplies all that is there by a number below 1 with each frame. Instead, each new frame is given as much
more weight, which touches only what it adds; now and then everything is brought back to scale.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from torch import Tensor

from napari_fiberburst.live.nodes import Nodes
from napari_fiberburst.operators.cg import Blocks, conjugate_gradients
from napari_fiberburst.operators.filters import filled_mean
from napari_fiberburst.operators.stencil import Stencil

# mu, in samples of weight 1 to a node. It holds the scene together between samples; how smooth the picture is, is
# decided when the footprint is undone.
TIE = 0.03
# Weights are brought back to scale before they have grown by this much.
_MOST_GROWTH = 1e4
# Nodes about the frame's pixels that are solved with them, in pitches, and those that it may move over beyond.
_MARGIN, _SLACK = 1.0, 10
# Planes: the five bands of the matrix, before the right-hand sides.
_BANDS = 5


class Memory:
    """The normal equations about the newest frame, and their solution.

    Parameters
    ----------
    shape : (int, int)
        Height and width of a frame, pixels.
    pitch : float
        Distance of neighbouring cores, pixels.
    area : float
        Pixels of a frame that show the object.
    channels : int
        Of the frames.
    """

    def __init__(self, shape: tuple[int, int], pitch: float, area: float, channels: int) -> None:
        self._margin = _MARGIN * pitch + 2
        rows, columns = (int(next_fast_len(side + 2 * round(self._margin + _SLACK), real=True)) for side in shape)
        self.nodes = Nodes(-((columns - shape[1]) // 2), -((rows - shape[0]) // 2), rows, columns)
        self._neighbours = _neighbours(rows, columns)
        self._area = area
        self.clear(channels)

    def clear(self, channels: int) -> None:
        """Forget everything."""
        self._growth, self._tied, self._total = 1.0, 0.0, 0.0
        self._planes = torch.zeros(_BANDS + channels, self.nodes.rows, self.nodes.columns)
        self.scene = torch.zeros(channels, self.nodes.rows, self.nodes.columns)
        self._tie(1.0)

    @property
    def density(self) -> float:
        """Weight of samples to a pixel that shows the object, in frames that count as the newest one does."""
        return self._total / self._growth

    @property
    def weight(self) -> Tensor:
        """How much each node has been seen, (rows, columns): the diagonal of the matrix without its prior."""
        seen: Tensor = (self._planes[0] - TIE * self._tied * self._neighbours) / self._growth
        return seen

    def centre_on(self, low: complex, high: complex) -> None:
        """Move the nodes so that a frame from one corner to the other lies well inside; what falls out is forgotten."""
        if self.nodes.holds(low, high, self._margin):
            return
        old, self.nodes = self.nodes, self.nodes.about((low + high) / 2)
        tied = self._tied
        self._tie(-tied)
        before, self._planes = self._planes, torch.zeros_like(self._planes)
        there_y, here_y = _overlap(old.y0, self.nodes.y0, old.rows)
        there_x, here_x = _overlap(old.x0, self.nodes.x0, old.columns)
        self._planes[:, here_y, here_x] = before[:, there_y, there_x]
        # What couples to nodes that fell out must not couple to those that come in their place: these have not been
        # seen, and the matrix would not be positive any more.
        self._planes[2:_BANDS, -1] = 0
        self._planes[[1, 3], :, -1] = 0
        self._planes[4, :, 0] = 0
        self._tie(tied)
        along_y, along_x = (
            (torch.arange(count) + new - start).clamp(0, count - 1)
            for count, new, start in ((old.rows, self.nodes.y0, old.y0), (old.columns, self.nodes.x0, old.x0))
        )
        self.scene = self.scene[:, along_y][:, :, along_x]

    def forget(self, kept: float) -> None:
        """Keep this part, 0 to 1, of the weight of all that was seen."""
        self._growth /= kept
        if self._growth > _MOST_GROWTH:
            self._planes /= self._growth
            self._total /= self._growth
            self._tied /= self._growth
            self._growth = 1.0
        self._tie(self._growth - self._tied)

    def add(self, points: NDArray[np.complex128], values: NDArray[np.float32], weights: NDArray[np.float32]) -> None:
        """Take samples in: values (N, C) and weights (N,) at points (N,), x + i y in pixels of the memory."""
        corners = self.nodes.corners(points)
        weights = weights * corners.inside * np.float32(self._growth)
        x, y, first = corners.x, corners.y, corners.first
        a, b, c, d = (1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y
        wa, wb, wc, wd = weights * a, weights * b, weights * c, weights * d
        size, step = self.nodes.rows * self.nodes.columns, self.nodes.columns
        right, below, below_right, below_left = (first + plane * size for plane in range(1, _BANDS))
        index = [first, first + 1, first + step, first + step + 1, right, right + step, below, below + 1]
        index += [below_right, below_left + 1]
        added = [wa * a, wb * b, wc * c, wd * d, wa * b, wd * c, wa * c, wd * b, wa * d, wb * c]
        for channel, light in enumerate(values.T):
            start = first + (_BANDS + channel) * size
            index += [start, start + 1, start + step, start + step + 1]
            added += [wa * light, wb * light, wc * light, wd * light]
        self._planes.view(-1).index_add_(
            0, torch.from_numpy(np.concatenate(index)), torch.from_numpy(np.concatenate(added))
        )
        self._total += float(weights.sum()) / self._area

    def start(self, width: float) -> None:
        """Let the scene be the local mean of what was seen, over a Gaussian of so many pixels: to begin with."""
        mass = Stencil(self._planes[:_BANDS]).row_sums
        self.scene = filled_mean(self._planes[_BANDS:], mass, width)

    def solve(self, iterations: int) -> None:
        """Take so many steps of conjugate gradients from the scene as it stands, (C, rows, columns)."""
        matrix = Stencil(self._planes[:_BANDS])
        inverse = matrix.diagonal.reciprocal()
        (self.scene,) = conjugate_gradients(
            lambda blocks: (matrix(blocks[0]),),
            (self._planes[_BANDS:],),
            lambda blocks: (inverse * blocks[0],),
            start=(self.scene,),
            iterations=iterations,
            tolerance=0.0,
            inner=_inner,
        )

    def _tie(self, change: float) -> None:
        """Give the prior this much more weight."""
        self._planes[0].add_(self._neighbours, alpha=TIE * change)
        self._planes[1:3] -= TIE * change
        self._tied += change


def _inner(first: Blocks, second: Blocks) -> Tensor:
    """Return the inner product of each image (C, H, W) with its counterpart, (C, 1, 1).

    In one pass, because it is taken ten times a frame; its last bits may depend on the number of threads.
    """
    (a,), (b,) = first, second
    products: Tensor = torch.linalg.vecdot(a.flatten(1), b.flatten(1))
    return products[:, None, None]


def _neighbours(rows: int, columns: int) -> Tensor:
    """Return how many neighbours each node has above, below and beside it, (rows, columns)."""
    count = torch.full((rows, columns), 4.0)
    for edge in (count[0], count[-1], count[:, 0], count[:, -1]):
        edge -= 1
    return count


def _overlap(old: int, new: int, count: int) -> tuple[slice, slice]:
    """Return which of `count` nodes from `old` on are among as many from `new` on, there and here; none, maybe."""
    first, last = max(old, new), max(max(old, new), min(old, new) + count)
    return slice(first - old, last - old), slice(first - new, last - new)
