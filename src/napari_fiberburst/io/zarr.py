"""OME-Zarr images, versions 0.4 and 0.5."""

from pathlib import Path
from typing import Any

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.recording import Recording, with_time

_MARKERS = ("zarr.json", ".zgroup", ".zattrs", ".zarray")


def is_zarr(path: Path) -> bool:
    """Whether a folder is a zarr group or array."""
    return any((path / name).exists() for name in _MARKERS)


def read_zarr(path: Path) -> Recording:
    """Open the full-resolution level of an OME-Zarr image; its chunks are read when the pixels are sliced.

    Raises
    ------
    BurstError
        zarr is not installed, or the folder is no OME-Zarr image.
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
        return _describe(pixels, image["axes"], level, ome.get("omero", {}))
    except Exception as error:  # zarr, its stores and its codecs each raise their own
        raise BurstError(
            f"{path} is no OME-Zarr image that can be read ({type(error).__name__}: {error}); expected multiscales "
            "with axes, as OME-NGFF 0.4 or 0.5 has them"
        ) from error


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
