"""Long recordings as layers: opened without being read, and given on as what works on recordings takes."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import BurstError
from napari_fiberburst.io import open_recording
from napari_fiberburst.io.picture import limits_of
from napari_fiberburst.plugin import METADATA_KEY, RECORDING_KEY
from napari_fiberburst.plugin.scrubbing import Frames

if TYPE_CHECKING:
    from napari_fiberburst.plugin.bursts import BurstSource

# A recording of more frames is one that a burst is chosen from.
LONGEST_BURST: Final = 50
# Contrast is told by so many frames, spread over the recording.
_LOOKED_AT = 8


def recording_layer(
    source: FrameSource, name: str, path: str | Sequence[str] | None = None
) -> tuple[Any, dict[str, Any], str]:
    """Return a recording as an image layer whose frames are read when they are shown.

    Parameters
    ----------
    source : FrameSource
        The recording.
    name : str
        Of the layer.
    path : str or sequence of str, optional
        What it was opened from.
    """
    known = source.acquisition
    is_colour = source.shape[3] == 3 and known.dtype == np.uint8
    frames = Frames(source, is_colour=is_colour)
    axes = frames.axes.removesuffix("C").lower()
    look: dict[str, Any] = {
        "name": name,
        "rgb": is_colour,
        "multiscale": False,
        "axis_labels": tuple(axes),
        "metadata": {METADATA_KEY: {RECORDING_KEY: recording_told(known), "recording_path": path}},
    }
    if not is_colour:
        look["contrast_limits"] = _limits(source)
    if known.pixel_size is not None:
        sizes = dict(zip("yx", known.pixel_size, strict=True))
        look["scale"] = tuple(sizes.get(axis, 1.0) for axis in axes)
        look["units"] = tuple(known.unit or "µm" if axis in sizes else "pixel" for axis in axes)
    return frames, look, "image"


def recording_told(known: Acquisition) -> dict[str, Any]:
    """Return what layers of a recording, and of what is made of it, keep in their metadata of it."""
    return {"channel_names": known.channel_names, "times": () if known.times is None else known.times.tolist()}


def recording_in(burst: "BurstSource", *, levels: tuple[float, float] | None = None) -> FrameSource:
    """Return all frames of the layers of a burst as a recording.

    Parameters
    ----------
    burst : BurstSource
        The layers.
    levels : (float, float), optional
        Intensities of black and white, where the frames do not tell them; by default they are looked for.

    Raises
    ------
    BurstError
        The axes do not fit the data.
    """
    (first, *further), axes = burst.arrays, burst.axes
    if isinstance(first, Frames) and not further and first.axes == axes:
        # With a file of its own, because who reads elsewhere in one that is scrubbed through makes both wait.
        source = replace(first.source, reader=deepcopy(first.source.reader))
    else:
        _ = burst.shape  # refuses axes that do not fit
        # What lies in one layer is not copied, nor read, into another order.
        whole, order = (burst.whole, None) if further else (first, axes)
        black, white = levels or (None, None)
        source = open_recording(whole, axes=order, black_level=black, white_level=white)
    known = replace(
        source.acquisition,
        pixel_size=burst.pixel_size or source.acquisition.pixel_size,
        unit=burst.unit or source.acquisition.unit,
        channel_names=burst.channel_names or source.acquisition.channel_names,
        times=source.acquisition.times if burst.times is None else np.array(burst.times),
    )
    return replace(source, acquisition=known, name=burst.name)


def reopened(source: FrameSource, path: str | Sequence[str] | None) -> FrameSource:
    """Open the file of a recording anew, because it may have changed since its layer was made.

    Raises
    ------
    BurstError
        It is no longer there, or holds something else.
    """
    if path is None:
        return source
    if open_recording(path).fingerprint != source.fingerprint:
        raise BurstError(f"{path} has changed since it was opened; open it again, and start on the new layer")
    return source


def name_of(path: str | Sequence[str]) -> str:
    """Return how the layer of a path is called."""
    return Path(path if isinstance(path, str) else path[0]).stem


def _limits(source: FrameSource) -> tuple[float, float]:
    numbers = sorted({round(place) for place in np.linspace(0, len(source) - 1, _LOOKED_AT).tolist()})
    low, high = limits_of(source.recorded(numbers).astype(np.float32))
    known = source.acquisition
    return (low, high) if high > low else (known.black_level, known.white_level)
