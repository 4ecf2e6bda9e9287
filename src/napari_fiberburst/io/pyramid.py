"""OME-Zarr 0.5 images and videos that are written a part at a time and opened at every zoom."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

# Pixels to a side of a chunk, and of the coarsest level at most.
CHUNK = 256
# Frames of a video to a chunk.
CHUNK_FRAMES = 8


def create_pyramid(
    path: Path,
    shape: tuple[int, ...],
    *,
    name: str,
    pixel_size: tuple[float, float] | None = None,
    unit: str | None = None,
    channels: tuple[str, ...] = (),
    times: NDArray[np.float64] | None = None,
    is_video: bool = False,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Make an image or a video of float32 with nothing in it: NaN.

    Parameters
    ----------
    path : Path
        Of the image's group.
    shape : tuple of int
        (H, W), or (C, H, W); of a video, T before it.
    name : str
        How the image is called.
    pixel_size : (float, float), optional
        Height and width of a pixel.
    unit : str, optional
        Of the pixel size, as OME-NGFF names it, such as "micrometer".
    channels : tuple of str
        Their names, where they have any.
    times : numpy.ndarray, optional
        (T,) seconds of the frames of a video. OME-NGFF knows even times alone: the scale is their median step.
    is_video : bool
        Whether the first axis is time.
    attributes : mapping, optional
        Of our own, beside what OME-NGFF asks for.
    """
    height, width = pixel_size or (1.0, 1.0)
    names = ("t",) * is_video + ("c",) * (len(shape) - 2 - is_video)
    start, step = (0.0, 1.0) if times is None or len(times) < 2 else (float(times[0]), float(np.median(np.diff(times))))
    datasets = []
    group = zarr.open_group(path, mode="w", zarr_format=3)
    for level, size in enumerate(_levels(shape)):
        factor = 2**level
        group.create_array(
            str(level),
            shape=size,
            chunks=(*(CHUNK_FRAMES if axis == "t" else 1 for axis in names), CHUNK, CHUNK),
            dtype=np.float32,
            fill_value=np.nan,
            dimension_names=(*names, "y", "x"),
        )
        # A pixel of a coarser level lies in the middle of those that it stands for.
        middle = (factor - 1) / 2
        scale = (step if axis == "t" else 1.0 for axis in names)
        origin = (start if axis == "t" else 0.0 for axis in names)
        datasets.append(
            {
                "path": str(level),
                "coordinateTransformations": [
                    {"type": "scale", "scale": [*scale, factor * height, factor * width]},
                    {"type": "translation", "translation": [*origin, middle * height, middle * width]},
                ],
            }
        )
    space = {"type": "space"} | ({} if unit is None or pixel_size is None else {"unit": unit})
    time = {"type": "time"} | ({} if times is None else {"unit": "second"})
    kinds = {"t": time, "c": {"type": "channel"}, "y": space, "x": space}
    axes = [{"name": axis, **kinds[axis]} for axis in (*names, "y", "x")]
    ome: dict[str, Any] = {"version": "0.5", "multiscales": [{"name": name, "axes": axes, "datasets": datasets}]}
    group.attrs.update({"ome": ome, **(attributes or {}), **({"channels": list(channels)} if channels else {})})


def write_frames(path: Path, first: int, frames: NDArray[np.floating]) -> None:
    """Write frames of a video, (n, [C,] H, W) from number `first` on, at every level; at whole chunks at once."""
    group = zarr.open_group(path, mode="r+")
    part = frames.astype(np.float32)
    for level in range(sum(1 for _ in group.array_keys())):
        if level > 0:
            part = _halved(part)
        zarr.open_array(path / str(level), mode="r+")[first : first + len(part)] = part


def write_tile(path: Path, rows: tuple[int, int], columns: tuple[int, int], tile: NDArray[np.floating]) -> None:
    """Write a part of an image's finest level, (h, w) or (C, h, w); at whole chunks, tiles can be written at once."""
    level = zarr.open_array(path / "0", mode="r+")
    level[..., slice(*rows), slice(*columns)] = tile.astype(np.float32)


def coarsen(path: Path, rows: tuple[int, int] | None = None, columns: tuple[int, int] | None = None) -> None:
    """Make an image's coarser levels from its finest one, a strip at a time: means of what is known.

    Parameters
    ----------
    path : Path
        Of the image's group.
    rows, columns : (int, int), optional
        The part [first, last) of the finest level that has changed; default, all of it.
    """
    group = zarr.open_group(path, mode="r+")
    count = sum(1 for _ in group.array_keys())
    for level in range(1, count):
        fine, coarse = (zarr.open_array(path / str(number), mode="r+") for number in (level - 1, level))
        (top, bottom), (left, right) = (
            (0, length) if part is None else (part[0] >> level, -(-part[1] >> level))
            for part, length in zip((rows, columns), coarse.shape[-2:], strict=True)
        )
        for first in range(top, bottom, CHUNK):
            last = min(first + CHUNK, bottom)
            strip = np.asarray(fine[..., 2 * first : 2 * last, 2 * left : 2 * right])
            coarse[..., first:last, left:right] = _halved(strip)


def _halved(image: NDArray[np.float32]) -> NDArray[np.float32]:
    odd = [(0, 0)] * (image.ndim - 2) + [(0, side % 2) for side in image.shape[-2:]]
    padded = np.pad(image, odd, constant_values=np.nan)
    *lead, rows, columns = padded.shape
    blocks = padded.reshape(*lead, rows // 2, 2, columns // 2, 2)
    known = np.isfinite(blocks)
    total, count = np.where(known, blocks, 0).sum(axis=(-3, -1)), known.sum(axis=(-3, -1))
    halved: NDArray[np.float32] = np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)
    return halved


def _levels(shape: tuple[int, ...]) -> list[tuple[int, ...]]:
    levels = [shape]
    while max(levels[-1][-2:]) > CHUNK:
        levels.append((*shape[:-2], *(-(-side // 2) for side in levels[-1][-2:])))
    return levels
