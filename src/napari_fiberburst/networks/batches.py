"""The burst as a shuffled stream of (x, y, t) samples, on the device of the run."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from napari_fiberburst.data.burst import Burst

# Spreads the seeds of consecutive epochs, so that seed 0, epoch 1 is not seed 1, epoch 0.
_SEED_STRIDE = 1_000_003


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
    Behind a bundle, points are (N, K, 2): K points of a sensor's footprint, of which it sees the mean.
    """

    points: Tensor
    frames: Tensor
    intensities: Tensor
    weights: Tensor | None = None


class Samples:
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
        self.drawn = drawn

    def draw(self, count: int) -> Batch:
        """Return the next `count` samples of the stream."""
        indices = torch.cat(list(self._next_indices(count)))
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


def shuffled(count: int, seed: int, epoch: int, device: torch.device) -> Tensor:
    """Return the numbers up to `count` in the order of an epoch."""
    generator = torch.Generator(device).manual_seed(seed + _SEED_STRIDE * epoch)
    return torch.randperm(count, generator=generator, device=device)
