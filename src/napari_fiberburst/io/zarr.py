"""OME-Zarr images, versions 0.4 and 0.5."""

import logging
import math
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.bounds import check_packed
from napari_fiberburst.io.recording import Recording, with_time

logger = logging.getLogger(__name__)

# Bytes of a chunk, which is unpacked whole however little of it is wanted; codecs take no more either.
_LARGEST_CHUNK = 2**31
# Of so many chunks one must be there; so many that are not are named.
_SPARSEST, _NAMED = 2**16, 3
_MARKERS = ("zarr.json", ".zgroup", ".zattrs", ".zarray")


def is_zarr(path: Path) -> bool:
    """Whether a folder is a zarr group or array."""
    return any((path / name).exists() for name in _MARKERS)


def read_zarr(path: Path) -> Recording:
    """Open the full-resolution level of an OME-Zarr image; its chunks are read when the pixels are sliced.

    Raises
    ------
    BurstError
        zarr is not installed; the folder is no OME-Zarr image, has no pixels, or claims more than it can hold.
    """
    try:
        import zarr
    except ImportError as error:
        raise BurstError(
            f"reading {path} needs the package zarr; install it by: pip install 'napari-fiberburst[zarr]'"
        ) from error
    try:
        group = zarr.open_group(str(path), mode="r")
        attributes: dict[str, Any] = dict(group.attrs)
        ome = attributes.get("ome", attributes)
        image = ome["multiscales"][0]
        level = image["datasets"][0]
        pixels = zarr.open_array(str(path / level["path"]), mode="r")
        _check_chunks(path / level["path"], pixels)
        return _describe(pixels, image["axes"], level, ome.get("omero", {}))
    except BurstError:
        raise
    except Exception as error:  # zarr, its stores and its codecs each raise their own
        raise BurstError(
            f"{path} is no OME-Zarr image that can be read ({type(error).__name__}: {error}); expected multiscales "
            "with axes, as OME-NGFF 0.4 or 0.5 has them"
        ) from error


def _check_chunks(path: Path, pixels: Any) -> None:
    """Refuse chunks that are none or too large, and say which are not there, because they count as black unnoticed.

    Chunks of nothing but the fill value may be left out, so that it cannot be told whether they are missing. Where that
    is NaN, as in what this package writes, nothing is made up.
    """
    chunk = pixels.shards or pixels.chunks
    largest = math.prod(pixels.chunks) * pixels.dtype.itemsize
    if largest > _LARGEST_CHUNK:
        raise BurstError(
            f"{path} has chunks of {largest / 2**20:,.0f} MiB, each of which is read whole; expected "
            f"{_LARGEST_CHUNK / 2**20:,.0f} at most; write it again with a chunk to each frame"
        )
    grid = [-(-length // side) for length, side in zip(pixels.shape, chunk, strict=True)]
    total = math.prod(grid)
    sizes = [file.stat().st_size for file in path.rglob("*") if file.is_file() and file.name not in _MARKERS]
    check_packed(path, min(total, len(sizes)) * math.prod(chunk) * pixels.dtype.itemsize, sum(sizes))
    if len(sizes) * _SPARSEST < total:
        raise BurstError(
            f"{path} has {len(sizes)} of its {total} chunks, which is next to nothing; copy it again, with all of them"
        )
    fill = pixels.fill_value
    if len(sizes) >= total or (pixels.dtype.kind == "f" and fill is not None and np.isnan(fill)):
        return
    places = (tuple(map(int, np.unravel_index(number, grid))) for number in range(total))
    keys = (pixels.metadata.encode_chunk_key(place) for place in places)
    named = ", ".join(islice((key for key in keys if not (path / key).exists()), _NAMED))
    more = " and more" if total - len(sizes) > _NAMED else ""
    logger.warning(
        "%d of %d chunks of %s are not there (%s%s) and count as %s; copy it again, unless its writer leaves out "
        "chunks of this value",
        *(total - len(sizes), total, path, named, more, 0 if fill is None else fill),
    )


def _describe(pixels: Any, axes: list[dict[str, str]], level: dict[str, Any], omero: dict[str, Any]) -> Recording:
    scale = next(
        (item["scale"] for item in level.get("coordinateTransformations", []) if item["type"] == "scale"),
        None,
    )
    names = "".join(axis["name"] for axis in axes).upper()
    y, x, t = (names.find(name) for name in "YXT")
    seconds = t >= 0 and axes[t].get("unit") == "second"
    return Recording(
        pixels=pixels,
        axes=with_time(names),
        channel_names=tuple(channel.get("label", "") for channel in omero.get("channels", [])),
        pixel_size=(scale[y], scale[x]) if scale and "unit" in axes[y] else None,
        unit=axes[y].get("unit"),
        times=[index * scale[t] for index in range(pixels.shape[t])] if scale and seconds else None,
    )
