"""The burst as a shuffled stream of (x, y, t) samples, on the device of the run."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from napari_fiberburst.burst import Burst

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
    """

    points: Tensor
    frames: Tensor
    intensities: Tensor


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
                self._order = self._shuffle(epoch)
                self._epoch = epoch
            part = self._order[position : position + count]
            self.drawn += len(part)
            count -= len(part)
            yield part

    def _shuffle(self, epoch: int) -> Tensor:
        generator = torch.Generator(self._device).manual_seed(self._seed + _SEED_STRIDE * epoch)
        return torch.randperm(self._total, generator=generator, device=self._device)
