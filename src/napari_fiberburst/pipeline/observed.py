"""The samples behind a bundle as a shuffled stream, for networks."""

import math

import torch
from torch import Tensor

from napari_fiberburst.coordinates import unit_from_pixel
from napari_fiberburst.networks.batches import Batch, shuffled
from napari_fiberburst.pipeline.alignment import Alignment

# A footprint is seen by seven points: its centre and six about it, with the second moment of an even disc.
_RING = math.sqrt(7 / 12)
# So many of the samples that are left out tell their error well enough.
_MOST_HELD_OUT = 8192


class ObservedSamples:
    """Every sample of an observation, in an order that is shuffled anew each time all have been seen.

    Parameters
    ----------
    aligned : Alignment
        A burst's samples, calibrated and registered.
    held_out : float
        Part of the samples that is left out.
    seed : int
        Seed of the shuffles, and of what is left out.

    Attributes
    ----------
    drawn : int
        Samples drawn so far.
    count : int
        Samples there are.
    """

    def __init__(self, aligned: Alignment, held_out: float, seed: int) -> None:
        seen = aligned.observation
        self._values = 2 * seen.values - 1
        self._weights = seen.weights
        device = seen.weights.device
        scale = torch.from_numpy(unit_from_pixel(aligned.shape)).to(seen.positions)
        offsets = torch.zeros(1, 2)
        if seen.radius is not None:
            angle = torch.arange(6) * math.pi / 3
            ring = _RING * seen.radius * torch.stack([angle.cos(), angle.sin()], dim=1)
            offsets = torch.cat([offsets, ring])
        places = seen.positions[:, None] + offsets.to(seen.positions)
        self._places = places * torch.diagonal(scale)[:2] + scale[:2, 2]
        generator = torch.Generator().manual_seed(seed)
        chance = torch.rand(seen.weights.shape, generator=generator).to(device)
        usable = seen.weights > 0
        self._kept = (usable & (chance >= held_out)).reshape(-1).nonzero()[:, 0]
        left_out = (usable & (chance < held_out)).reshape(-1).nonzero()[:, 0]
        self._left_out = left_out[:: max(1, -(-len(left_out) // _MOST_HELD_OUT))]
        self._seed = seed
        self._epoch = -1
        self._order = self._kept
        self.count = len(self._kept)
        self.drawn = 0

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
        return self._batch(torch.cat(parts))

    def left_out(self) -> Batch | None:
        """Return samples that are never drawn; None where there are none."""
        return self._batch(self._left_out) if len(self._left_out) else None

    def _batch(self, indices: Tensor) -> Batch:
        sensors = len(self._places)
        frames, sensor = indices // sensors, indices % sensors
        return Batch(self._places[sensor], frames, self._values[frames, sensor], self._weights[frames, sensor])
