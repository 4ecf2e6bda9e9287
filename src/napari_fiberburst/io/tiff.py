"""TIFF stacks, with what OME and ImageJ metadata say of axes, pixel size, channels and times."""

import struct
from pathlib import Path
from typing import Any

import tifffile

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.recording import Recording

TIFF_ENDINGS = (".tif", ".tiff")
# What tifffile calls the axis of pages where the file does not name one; a burst has no depth.
_PAGE_AXES = "QIZ"


def read_tiff(path: Path) -> Recording:
    """Read the first series of a TIFF file.

    Raises
    ------
    BurstError
        The file is empty, cut short, or no TIFF.
    """
    if path.stat().st_size == 0:
        raise BurstError(f"{path} is empty; copy or export it again")
    try:
        with tifffile.TiffFile(path) as file:
            if _is_cut_short(file):
                raise BurstError(f"{path} is cut short: its last frames are missing; copy or export it again")
            series = file.series[0]
            described = _from_ome(file) or _from_imagej(file)
            return Recording(pixels=series.asarray(), axes=_with_time(series.axes), **described)
    except BurstError:
        raise
    except Exception as error:  # tifffile and its codecs fail on damaged files in many ways
        raise BurstError(f"{path} cannot be read as TIFF ({error}); copy or export it again") from error


def _is_cut_short(file: tifffile.TiffFile) -> bool:
    """Whether the last page that could be read points to a further one beyond the end of the file.

    tifffile only logs this, and reads what is left as if it were the whole.
    """
    handle, layout = file.filehandle, file.tiff
    last = file.pages[len(file.pages) - 1].offset
    handle.seek(last)
    (tags,) = struct.unpack(layout.tagnoformat, handle.read(layout.tagnosize))
    handle.seek(last + layout.tagnosize + tags * layout.tagsize)
    (following,) = struct.unpack(layout.offsetformat, handle.read(layout.offsetsize))
    return bool(following >= handle.size)


def _with_time(axes: str) -> str:
    if "T" not in axes:
        for page_axis in _PAGE_AXES:
            if page_axis in axes:
                return axes.replace(page_axis, "T")
    return axes


def _from_ome(file: tifffile.TiffFile) -> dict[str, Any]:
    if not file.is_ome or not file.ome_metadata:
        return {}
    image = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
    pixels = (image[0] if isinstance(image, list) else image)["Pixels"]
    described: dict[str, Any] = {}
    if "PhysicalSizeX" in pixels and "PhysicalSizeY" in pixels:
        described["pixel_size"] = (float(pixels["PhysicalSizeY"]), float(pixels["PhysicalSizeX"]))
        described["unit"] = pixels.get("PhysicalSizeXUnit", "µm")
    channels = _as_list(pixels.get("Channel"))
    names = tuple(str(channel["Name"]) for channel in channels if "Name" in channel)
    if names and len(names) == int(pixels["SizeC"]):
        described["channel_names"] = names
    count = int(pixels["SizeT"])
    deltas = {plane["TheT"]: float(plane["DeltaT"]) for plane in _as_list(pixels.get("Plane")) if "DeltaT" in plane}
    if len(deltas) == count:
        described["times"] = [deltas[index] for index in range(count)]
    elif "TimeIncrement" in pixels:
        described["times"] = [index * float(pixels["TimeIncrement"]) for index in range(count)]
    return described


def _from_imagej(file: tifffile.TiffFile) -> dict[str, Any]:
    known = file.imagej_metadata
    if not known:
        return {}
    described: dict[str, Any] = {}
    tags = file.pages.first.tags
    if known.get("unit") and "XResolution" in tags and "YResolution" in tags:
        y, x = (tags[name].value for name in ("YResolution", "XResolution"))
        described["pixel_size"] = (y[1] / y[0], x[1] / x[0])
        # ImageJ escapes the micro sign.
        described["unit"] = str(known["unit"]).replace("\\u00B5", "µ")
    if known.get("finterval"):
        described["times"] = [index * float(known["finterval"]) for index in range(int(known.get("frames", 1)))]
    return described


def _as_list(value: Any) -> list[Any]:
    """Return what xml2dict gives for an element that may stand once, often or never."""
    if value is None:
        return []
    return value if isinstance(value, list) else [value]
