"""FrameSource: a recording of any length, of which frames are read when they are wanted."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Acquisition, Burst
from napari_fiberburst.errors import BurstError


class Reader(Protocol):
    """Reads frames of one recording. It can be pickled: another process opens its file anew."""

    def __call__(self, numbers: Sequence[int]) -> NDArray[np.generic]:
        """Return frames by their numbers, any of them in any order, (n, H, W, C) in the type they were recorded in."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FrameSource:
    """The frames of a recording, read when they are asked for.

    Attributes
    ----------
    acquisition : Acquisition
        What is known of the recording; its first axis is the number of frames.
    reader : Reader
        Reads them.
    name : str
        How it is called where it is talked of, such as its path.
    fingerprint : str
        Another one where the frames are others: of the files' names, sizes and times of change, for example. Work that
        was done on a recording is gone on with only where it is the same.
    """

    acquisition: Acquisition
    reader: Reader
    name: str
    fingerprint: str

    def __len__(self) -> int:
        return self.acquisition.shape[0]

    def __repr__(self) -> str:
        count, height, width, channels = self.acquisition.shape
        return (
            f"FrameSource({self.name}: {count} frames of {height} x {width}, {channels} channels, "
            f"{self.acquisition.dtype})"
        )

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Frames, height, width and channels."""
        return self.acquisition.shape

    def recorded(self, numbers: Sequence[int]) -> NDArray[np.generic]:
        """Return frames (n, H, W, C) as they were recorded.

        Raises
        ------
        BurstError
            There is no frame of such a number, or it cannot be read.
        """
        outside = [number for number in numbers if not 0 <= number < len(self)]
        if outside:
            raise BurstError(f"{self.name} has frames 0 to {len(self) - 1}; there is no frame {outside[0]}")
        return self.reader(numbers)

    def values(self, numbers: Sequence[int]) -> NDArray[np.float32]:
        """Return frames (n, H, W, C) in [0, 1], as those of a `Burst` are.

        Raises
        ------
        BurstError
            As `recorded`; or a frame holds NaN or infinity.
        """
        values = self.recorded(numbers).astype(np.float32)
        black, white = self.acquisition.black_level, self.acquisition.white_level
        values -= np.float32(black)
        values /= np.float32(white - black)
        finite = np.isfinite(values).all(axis=(1, 2, 3))
        if not finite.all():
            raise BurstError(
                f"frames must be finite, but frame {numbers[int(finite.argmin())]} of {self.name} holds NaN or "
                "infinity; replace those pixels or leave the frame out"
            )
        return np.clip(values, 0, 1, out=values)

    def in_parts(self, most: int = 2**26) -> Iterator[range]:
        """Return the numbers of all frames in parts of at most so many bytes as float32, one frame at least."""
        step = max(1, most // (4 * int(np.prod(self.shape[1:]))))
        for first in range(0, len(self), step):
            yield range(first, min(first + step, len(self)))

    def burst(self, numbers: Sequence[int]) -> Burst:
        """Return some frames as a burst.

        Raises
        ------
        BurstError
            As `recorded`; or they cannot be a burst, because all of them are constant, for example.
        """
        known = self.acquisition
        frames = self.recorded(numbers)
        return Burst(
            frames if "C" in known.axes else frames[..., 0],
            axes=known.axes,
            black_level=known.black_level,
            white_level=known.white_level,
            channel_names=known.channel_names,
            pixel_size=known.pixel_size,
            unit=known.unit,
            times=None if known.times is None else known.times[list(numbers)],
        )

    def take(self, numbers: Sequence[int]) -> "FrameSource":
        """Return a recording of some of the frames, in this order, still unread."""
        chosen = tuple(numbers)
        if not chosen:
            raise BurstError(f"no frame of {self.name} is left; choose some of 0 to {len(self) - 1}")
        known = self.acquisition
        times = None if known.times is None else known.times[list(chosen)]
        return replace(
            self,
            acquisition=replace(known, shape=(len(chosen), *known.shape[1:]), times=times),
            reader=_Some(self, chosen),
            fingerprint=sha256(f"{self.fingerprint}{chosen}".encode()).hexdigest(),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Some:
    """Reads some frames of another source."""

    source: FrameSource
    chosen: tuple[int, ...]

    def __call__(self, numbers: Sequence[int]) -> NDArray[np.generic]:
        return self.source.recorded([self.chosen[number] for number in numbers])
