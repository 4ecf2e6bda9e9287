"""Frames as small even images, by which they are found in one another."""

import math
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from napari_fiberburst.motion.coarse import evened
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.traces import Traces

# Cells of the images, in pitches, as long as there are at most so many to a side.
_CELL, _MOST_SIDE = 0.43, 192
# In pitches: the images are smoothed over this (sigma), and evened out over that.
_SMOOTHED, _NEIGHBOURHOOD = 0.55, 2.2
# Cores farther than so many sigmas from a cell have no part in it.
_REACH = 2.5
# Where the cores about a cell weigh less than this part of the usual, or less of them have been seen, it is not known.
_LEAST_MASS, _LEAST_SEEN = 0.25, 0.7
# Least light, relative to that of the usual core, that a core's mean has, for it to have a part.
_LEAST_LIGHT = 0.02
# So many images are kept.
_KEPT = 512


class Views:
    """Small images (h, w) of frames, and where they show something, made when they are asked for.

    Each core's light is taken relative to its own mean over the recording, because that is what a wide path leaves of
    its gain. Cells are read from the cores about them by local regression of first order (Cleveland, "Robust locally
    weighted regression", Journal of the American Statistical Association 74, 1979): a mean by weights would show at
    each cell what lies a little beside it, wherever its cores are not evenly about it, which is always the same in the
    frame and draws all frames together. Then each image is brought to one brightness and contrast about every pixel.

    Attributes
    ----------
    spacing : float
        Pixels of the frame to a cell.
    shape : (int, int)
        h and w.
    pitch : float
        Distance of neighbouring cores, pixels of the frame.
    """

    def __init__(self, traces: Traces) -> None:
        self._traces = traces
        template = traces.template
        self.pitch = template.pitch
        self._grid = grid_of(template.shape, template.pitch)
        self.spacing, self.shape = self._grid.spacing, self._grid.shape
        mean = traces.summary.mean_light
        usual = float(mean[mean > 0].median()) if bool((mean > 0).any()) else 1.0
        self._bright = mean > _LEAST_LIGHT * usual
        self._mean_light = mean.clamp_min(_LEAST_LIGHT * usual)
        sigma = max(_SMOOTHED * template.pitch, 0.5 * self.spacing)
        positions, bright = template.positions.double().numpy(), self._bright.numpy()
        self._operator, known = _regression(self._grid, positions, bright, sigma)
        self._known = torch.from_numpy(known)
        self._neighbourhood = max(2.0, _NEIGHBOURHOOD * template.pitch / self.spacing)
        self._inner_known = self._inner_of(self._known)
        self.at = lru_cache(maxsize=_KEPT)(self._make)

    def inner(self, number: int) -> Tensor:
        """Return where an image is as the other ones are that see the same place, (h, w), 1 or 0.

        Near its edge an image is evened out over what lies on one side alone, which differs from what another frame has
        there, and would draw the two together.
        """
        mask = self.at(number)[1]
        return self._inner_known if mask is self._known else self._inner_of(mask)

    def _inner_of(self, mask: Tensor) -> Tensor:
        reach = math.ceil(self._neighbourhood)
        square = np.ones((2 * reach + 1,) * 2, bool)
        return torch.from_numpy(binary_erosion(mask.numpy(), square).astype(np.float32))

    def _make(self, number: int) -> tuple[Tensor, Tensor]:
        samples = self._traces.samples([number])
        seen = (samples.weights[0] > 0) & self._bright
        relative = samples.grey[0] / self._mean_light
        middle = relative[seen].mean() if bool(seen.any()) else relative.new_tensor(1.0)
        relative = torch.where(seen, relative - middle, torch.zeros_like(relative))
        image = torch.from_numpy(self._operator @ relative.numpy()).reshape(self.shape)
        mask = self._known
        if not bool((seen | ~self._bright).all()):
            share = torch.from_numpy(self._operator @ seen.float().numpy()).reshape(self.shape)
            mask = mask & (share > _LEAST_SEEN)
        return evened(image, mask, self._neighbourhood), mask


def _regression(
    grid: Grid, positions: NDArray[np.float64], used: NDArray[np.bool_], sigma: float
) -> tuple[csr_array, NDArray[np.bool_]]:
    """Return what reads cells from cores, (h w, N), and which cells are known, (h, w).

    By the value of a plane fitted to the cores about a cell, weighed by a Gaussian.
    """
    nodes = grid.nodes().reshape(-1, 2).double().numpy()
    numbers = np.flatnonzero(used)
    near = cKDTree(positions[numbers]).query_ball_point(nodes, _REACH * sigma)
    counts = np.array([len(found) for found in near])
    cell = np.repeat(np.arange(len(nodes)), counts)
    core = numbers[np.concatenate([np.asarray(found, dtype=np.int64) for found in near])]
    away = (positions[core] - nodes[cell]) / sigma
    weight = np.exp(-(away**2).sum(axis=1) / 2)
    basis = np.concatenate([np.ones((len(cell), 1)), away], axis=1)
    moments = np.zeros((len(nodes), 3, 3))
    np.add.at(moments, cell, weight[:, None, None] * basis[:, :, None] * basis[:, None, :])
    mass = moments[:, 0, 0].copy()
    known = (mass > _LEAST_MASS * np.median(mass[mass > 0])) & (counts >= 3)
    # Where cores lie on one side alone, a plane would reach far beyond them.
    moments[:, [1, 2], [1, 2]] += 0.1 * mass[:, None] + 1e-9
    moments[:, 0, 0] += 1e-9
    first = np.linalg.inv(moments)[:, 0]
    entries = weight * (first[cell] * basis).sum(axis=1) * known[cell]
    return csr_array((entries.astype(np.float32), (cell, core)), shape=(len(nodes), len(positions))), known.reshape(
        grid.shape
    )


def grid_of(shape: tuple[int, int], pitch: float) -> Grid:
    """Return the cells of the images of frames (height, width) of a bundle, in frame pixels."""
    height, width = shape
    return Grid.over((0, 0, width - 1, height - 1), max(_CELL * pitch, max(height, width) / _MOST_SIDE))


def middle_of(shape: tuple[int, int], pitch: float) -> tuple[float, float]:
    """Return the middle of the images (x, y), frame pixels: links and poses are about it."""
    grid = grid_of(shape, pitch)
    rows, columns = grid.shape
    return grid.x0 + (columns - 1) / 2 * grid.spacing, grid.y0 + (rows - 1) / 2 * grid.spacing
