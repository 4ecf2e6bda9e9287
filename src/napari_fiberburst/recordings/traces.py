"""What every core of a bundle has seen in every frame: all that is needed of a recording, at a tenth of its size."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.samples import SATURATED, Samples, in_grey, sample_cores
from napari_fiberburst.data.source import FrameSource

# Frames that vary less than this part of the median frame are black, white or empty in another way.
_LEAST_CONTRAST_OF_USUAL = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Traces:
    """One value a core and frame.

    Attributes
    ----------
    bundle : Bundle
        Whose cores they are.
    values : numpy.ndarray
        (T, N, C) float32, as those of `Samples`; in a file on the disk where they were asked to be.
    weights : numpy.ndarray
        (T, N) float32, as those of `Samples`.
    shows : numpy.ndarray
        (T,) bool, frames that show something: not all black, white or even.
    template : Samples
        Of no frame: what all frames have in common.
    """

    bundle: Bundle
    values: NDArray[np.float32]
    weights: NDArray[np.float32]
    shows: NDArray[np.bool_]
    template: Samples

    def __len__(self) -> int:
        return len(self.values)

    def samples(self, numbers: Sequence[int]) -> Samples:
        """Return the samples of some frames."""
        chosen = list(numbers)
        values, weights = np.array(self.values[chosen]), np.array(self.weights[chosen])
        weights[~self.shows[chosen]] = 0
        return replace(self.template, values=torch.from_numpy(values), weights=torch.from_numpy(weights))


def trace(source: FrameSource, bundle: Bundle, folder: Path | None = None) -> Generator[int, None, Traces]:
    """Sample every frame of a recording by the cores of a bundle; yields how many frames are done.

    Parameters
    ----------
    source : FrameSource
        The recording, read once, a part at a time.
    bundle : Bundle
        At the place where it is in these frames.
    folder : Path, optional
        Where to keep the values on the disk; by default they are in memory, 8 bytes a core and frame, or 4 more for
        each further channel.
    """
    count, _, _, channels = source.shape
    cores = len(bundle.centres)
    values = _array(folder, "values", (count, cores, channels))
    weights = _array(folder, "weights", (count, cores))
    contrast, bright = np.zeros(count), np.zeros(count)
    template: Samples | None = None
    for part in source.in_parts():
        frames = torch.from_numpy(source.values(part))
        samples = sample_cores(frames, bundle, source.acquisition)
        grey = in_grey(frames)
        rows = slice(part.start, part.stop)
        values[rows], weights[rows] = samples.values.numpy(), samples.weights.numpy()
        contrast[rows] = grey.std(dim=(1, 2)).numpy()
        bright[rows] = (grey >= SATURATED).float().mean(dim=(1, 2)).numpy()
        template = replace(samples, values=samples.values[:0], weights=samples.weights[:0])
        yield part.stop
    assert template is not None  # a recording has frames
    shows = (contrast > _LEAST_CONTRAST_OF_USUAL * np.median(contrast)) & (bright < 0.5)
    return Traces(bundle=bundle, values=values, weights=weights, shows=shows, template=template)


def _array(folder: Path | None, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    if folder is None:
        return np.zeros(shape, np.float32)
    array: NDArray[np.float32] = np.lib.format.open_memmap(folder / f"{name}.npy", "w+", np.float32, shape)
    return array
