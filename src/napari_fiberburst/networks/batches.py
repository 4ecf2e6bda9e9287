"""The burst as a shuffled stream of (x, y, t) samples, on the device of the run.

As published, of all pixels of all frames; behind a calibrated bundle, of its samples.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.control import Region
from napari_fiberburst.coordinates import transform_points, unit_from_pixel
from napari_fiberburst.data.burst import Burst

# Spreads the seeds of consecutive epochs, so that seed 0, epoch 1 is not seed 1, epoch 0.
_SEED_STRIDE = 1_000_003
# A footprint is sampled at seven points: its centre and six about it, with the second moment of an even disc.
_RING = math.sqrt(7 / 12)
# So many of the samples that are left out tell their error well enough.
_MOST_HELD_OUT = 8192
# So many samples of a region that is favoured are drawn to each that is drawn anyhow.
_FAVOURED = 0.5


class Batch(NamedTuple):
    """Some samples of the burst.

    Attributes
    ----------
    points : Tensor
        (N, 2) as (x, y) in unit coordinates of the frame.
    frames : Tensor
        (N,) frame numbers.
    intensities : Tensor
        (N, C) in [-1, 1].
    weights : Tensor or None
        (N,) how much each counts; None where all count the same.

    Notes
    -----
    Behind a bundle, points are (N, K, 2): K points of a core's footprint, of which it sees the mean.
    """

    points: Tensor
    frames: Tensor
    intensities: Tensor
    weights: Tensor | None = None

    @property
    def weight(self) -> Tensor:
        """How much all samples count, a scalar."""
        return self.frames.new_tensor(len(self.frames)) if self.weights is None else self.weights.sum()

    def split(self, parts: int) -> Iterator["Batch"]:
        """Yield so many parts of about the same size, in turn."""
        yield from (Batch(*of) for of in zip(*(_split(value, parts) for value in self), strict=True))


class _Favoured:
    """Samples of a region, which are drawn beside those of a stream.

    Parameters
    ----------
    indices : Tensor
        (N,) int64, numbers of the samples.
    seed : int
        Of the order in which they come.
    """

    def __init__(self, indices: Tensor, seed: int) -> None:
        self._indices = indices
        self._generator = torch.Generator(indices.device).manual_seed(seed)

    def beside(self, indices: Tensor) -> Tensor:
        """Return a stream's indices, and some of the region's."""
        count = round(_FAVOURED * len(indices))
        shape = (count,)
        drawn = torch.randint(len(self._indices), shape, generator=self._generator, device=self._indices.device)
        return torch.cat([indices, self._indices[drawn]])


def _inside(region: Region, places: Tensor, homographies: NDArray[np.float64]) -> Tensor:
    """Return which places (N, 2) lie in a region of frame 0, for each frame (T, N), by (T, 3, 3) to its pixels."""
    x0, y0, x1, y1 = region
    found = []
    for matrix in torch.from_numpy(homographies).to(places):
        x, y = transform_points(matrix, places).unbind(dim=1)
        found.append((x >= x0) & (x < x1) & (y >= y0) & (y < y1))  # NaN is outside
    return torch.stack(found)


class PixelStream:
    """Every pixel of every frame, in an order that is shuffled anew each time all have been seen.

    The position in the stream is one number, `drawn`: a run that goes on from it sees what it would have seen.

    Parameters
    ----------
    burst : Burst
        Its frames are moved to the device once; on the CPU they are shared, not copied.
    device : torch.device
        Where batches are made. Coordinates are computed there, and nothing waits for the device.
    seed : int
        Seed of the shuffles.
    drawn : int
        Samples that were drawn before.
    """

    def __init__(self, burst: Burst, device: torch.device, seed: int, drawn: int = 0) -> None:
        count, self._height, self._width, channels = burst.shape
        self._values = torch.from_numpy(burst.frames).to(device).view(-1, channels)
        self._frame_size = self._height * self._width
        self._total = count * self._frame_size
        self._device = device
        self._seed = seed
        self._epoch = -1
        self._order = torch.empty(0, dtype=torch.int64)
        self._favoured: _Favoured | None = None
        self.drawn = drawn

    def favour(self, region: Region | None, homographies: NDArray[np.float64]) -> None:
        """Draw more samples of a region of frame 0, by where the frames (T, 3, 3) lie in its pixels; None of none."""
        self._favoured = None
        if region is None:
            return
        x, y = torch.meshgrid(torch.arange(self._width), torch.arange(self._height), indexing="xy")
        places = torch.stack([x, y], dim=-1).reshape(-1, 2).to(self._device, torch.float32)
        inside = _inside(region, places, homographies).reshape(-1).nonzero()[:, 0]
        self._favoured = _Favoured(inside, self._seed) if len(inside) else None

    def draw(self, count: int) -> Batch:
        """Return the next `count` samples of the stream."""
        indices = torch.cat(list(self._next_indices(count)))
        if self._favoured is not None:
            indices = self._favoured.beside(indices)
        frames = indices // self._frame_size
        within = indices % self._frame_size
        x = (2 * (within % self._width) + 1) / self._width - 1
        y = (2 * (within // self._width) + 1) / self._height - 1
        return Batch(torch.stack([x, y], dim=1), frames, 2 * self._values[indices] - 1)

    def _next_indices(self, count: int) -> Iterator[Tensor]:
        while count:
            epoch, position = divmod(self.drawn, self._total)
            if epoch != self._epoch:
                self._order = shuffled(self._total, self._seed, epoch, self._device)
                self._epoch = epoch
            part = self._order[position : position + count]
            self.drawn += len(part)
            count -= len(part)
            yield part


class BundleStream:
    """Every sample of a bundle, in an order that is shuffled anew each time all have been samples.

    Parameters
    ----------
    samples : Samples
        Gains taken out.
    held_out : float
        Part of the samples that is left out.
    seed : int
        Seed of the shuffles, and of what is left out.
    offsets : numpy.ndarray, optional
        (T, 2), pixels: how far from their positions the samples lie in each frame; by default nowhere.

    Attributes
    ----------
    drawn : int
        Samples drawn so far.
    count : int
        Samples there are.
    """

    def __init__(
        self, samples: Samples, held_out: float, seed: int, offsets: NDArray[np.float64] | None = None
    ) -> None:
        self._values = 2 * samples.values - 1
        self._weights = samples.weights
        device = samples.weights.device
        scale = torch.from_numpy(unit_from_pixel(samples.shape)).to(samples.positions)
        footprint = torch.zeros(1, 2)
        if samples.radius is not None:
            angle = torch.arange(6) * math.pi / 3
            ring = _RING * samples.radius * torch.stack([angle.cos(), angle.sin()], dim=1)
            footprint = torch.cat([footprint, ring])
        places = samples.positions[:, None] + footprint.to(samples.positions)
        self._places = places * torch.diagonal(scale)[:2] + scale[:2, 2]
        moves = torch.zeros(len(samples.values), 2) if offsets is None else torch.from_numpy(offsets)
        self._moves = moves.to(places) * torch.diagonal(scale)[:2]
        generator = torch.Generator().manual_seed(seed)
        chance = torch.rand(samples.weights.shape, generator=generator).to(device)
        usable = samples.weights > 0
        self._kept = (usable & (chance >= held_out)).reshape(-1).nonzero()[:, 0]
        left_out = (usable & (chance < held_out)).reshape(-1).nonzero()[:, 0]
        self._left_out = left_out[:: max(1, -(-len(left_out) // _MOST_HELD_OUT))]
        self._seed = seed
        self._epoch = -1
        self._order = self._kept
        self._favoured: _Favoured | None = None
        self._positions = samples.positions
        self.count = len(self._kept)
        self.drawn = 0

    def favour(self, region: Region | None, homographies: NDArray[np.float64]) -> None:
        """Draw more samples of a region of frame 0, by where the frames (T, 3, 3) lie in its pixels; None of none."""
        self._favoured = None
        if region is None:
            return
        inside = _inside(region, self._positions, homographies).reshape(-1)
        kept = self._kept[inside[self._kept]]
        self._favoured = _Favoured(kept, self._seed) if len(kept) else None

    def draw(self, count: int) -> Batch:
        """Return the next `count` samples of the stream."""
        parts = []
        while count > 0:
            epoch, position = divmod(self.drawn, self.count)
            if epoch != self._epoch:
                self._order = self._kept[shuffled(self.count, self._seed, epoch, self._kept.device)]
                self._epoch = epoch
            part = self._order[position : position + count]
            self.drawn += len(part)
            count -= len(part)
            parts.append(part)
        indices = torch.cat(parts)
        return self._batch(indices if self._favoured is None else self._favoured.beside(indices))

    def left_out(self) -> Batch | None:
        """Return samples that are never drawn; None where there are none."""
        return self._batch(self._left_out) if len(self._left_out) else None

    def _batch(self, indices: Tensor) -> Batch:
        frames, place = indices // len(self._places), indices % len(self._places)
        points = self._places[place] + self._moves[frames][:, None]
        return Batch(points, frames, self._values[frames, place], self._weights[frames, place])


def shuffled(count: int, seed: int, epoch: int, device: torch.device) -> Tensor:
    """Return the numbers up to `count` in the order of an epoch."""
    generator = torch.Generator(device).manual_seed(seed + _SEED_STRIDE * epoch)
    return torch.randperm(count, generator=generator, device=device)


def _split(values: Tensor | None, parts: int) -> Sequence[Any]:
    return [None] * parts if values is None else values.tensor_split(parts)
