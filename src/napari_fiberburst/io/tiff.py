"""TIFF stacks, with what OME and ImageJ metadata say of axes, pixel size, channels and times."""

import logging
import math
import struct
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import tifffile
from numpy.typing import NDArray

from napari_fiberburst.data.burst import check_frame
from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.bounds import check_file, check_packed
from napari_fiberburst.io.lazy import Handle, Parts
from napari_fiberburst.io.recording import Recording, with_time
from napari_fiberburst.io.results import write_whole

logger = logging.getLogger(__name__)

TIFF_ENDINGS = (".tif", ".tiff")
# Pages that OME metadata may tell of; tifffile takes memory for each, whether it is there or not.
_MOST_PAGES = 2**22
_SECONDS = {"ns": 1e-9, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}


def read_tiff(path: Path) -> Recording:
    """Open the frames of a TIFF file: its first series, or all its pages where each is a series of its own.

    Pages are read when the pixels are sliced.

    Raises
    ------
    BurstError
        The file is empty, cut short, of pages of different sizes, no TIFF, or claims more than it can hold.
    """
    check_file(path)
    try:
        handle = Handle(partial(_OpenTiff, path))
        with handle.use() as tiff:
            _check_whole(path, tiff.file)
            blank, axes = _light(np.zeros(tiff.part, tiff.dtype), tiff.part_axes, tiff.keyframe)
            pixels = Parts(_Pages(path, handle), tiff.leading, blank.shape, blank.dtype)
            axes = with_time(tiff.leading_axes + axes)
            count = pixels.shape[axes.index("T")] if "T" in axes else 1
            return Recording(pixels=pixels, axes=axes, **_described(tiff.file, count))
    except BurstError:
        raise
    except Exception as error:  # tifffile and its codecs fail on damaged files in many ways
        raise BurstError(f"{path} cannot be read as TIFF ({error}); copy or export it again") from error


def describe_tiff(path: Path) -> dict[str, Any]:
    """Return what a TIFF file says beside its pixels, by the names that `Recording` has; {} where it says nothing.

    Raises
    ------
    BurstError
        It is no TIFF.
    """
    try:
        with tifffile.TiffFile(path) as file:
            _check_pages(path, file)
            series = file.series[0]
            axes = with_time(series.axes)
            return _described(file, series.shape[axes.index("T")] if "T" in axes else 1)
    except Exception as error:  # as in `read_tiff`
        raise BurstError(f"{path} cannot be read as TIFF ({error}); copy or export it again") from error


def write_frames(
    path: Path,
    frames: NDArray[Any],
    times: NDArray[np.float64],
    pixel_size: tuple[float, float] | None = None,
    unit: str | None = None,
) -> None:
    """Write frames (T, H, W, C) as they are, and when they were taken in seconds, as OME-TIFF.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    is_colour = frames.shape[3] == 3 and frames.dtype == np.uint8
    shown, axes = (frames, "TYXS") if is_colour else (frames.transpose(0, 3, 1, 2), "TCYX")
    planes = len(frames) * (1 if is_colour else frames.shape[3])
    seconds = np.repeat(times - times[0], planes // len(frames)).tolist()
    described: dict[str, Any] = {"axes": axes, "Plane": {"DeltaT": seconds, "DeltaTUnit": ["s"] * planes}}
    if pixel_size is not None:
        height, width = pixel_size
        described |= {"PhysicalSizeY": height, "PhysicalSizeX": width, "PhysicalSizeXUnit": unit or "µm"}
        described["PhysicalSizeYUnit"] = unit or "µm"
    with write_whole(path) as stream:
        tifffile.imwrite(stream, shown, ome=True, photometric="rgb" if is_colour else "minisblack", metadata=described)


def _check_pages(path: Path, file: tifffile.TiffFile) -> None:
    """Refuse pages that tifffile would look for without end, before it is asked for series."""
    _check_chain(path, file)
    _check_told(path, file)


def _check_chain(path: Path, file: tifffile.TiffFile) -> None:
    """Refuse pages each of which points to the next one, and one of them back."""
    offset, seen = file.pages.first.offset, set[int]()
    while offset:
        if offset in seen:
            raise BurstError(f"the pages of {path} lead back to one another, and have no end; export it again")
        seen.add(offset)
        try:
            offset = _following(file, offset)
        except (struct.error, OSError):
            return  # it is cut short, which is told later


def _following(file: tifffile.TiffFile, offset: int) -> int:
    """Return where the page after the one at an offset is; 0 after the last."""
    handle, layout = file.filehandle, file.tiff
    handle.seek(offset)
    (tags,) = struct.unpack(layout.tagnoformat, handle.read(layout.tagnosize))
    handle.seek(offset + layout.tagnosize + tags * layout.tagsize)
    (following,) = struct.unpack(layout.offsetformat, handle.read(layout.offsetsize))
    return int(following)


def _check_told(path: Path, file: tifffile.TiffFile) -> None:
    """Refuse OME metadata that tell of more pages than any file has, before they are looked for."""
    if not (file.is_ome and file.ome_metadata):
        return
    try:
        document = ElementTree.fromstring(file.ome_metadata)
        told = [[int(part.get(f"Size{axis}", 1)) for axis in "TCZYX"] for part in document.findall(".//{*}Pixels")]
    except (ElementTree.ParseError, ValueError):
        return  # tifffile goes by the pages alone then
    most = _MOST_PAGES * math.prod(file.pages.first.shape)
    for sizes in told:
        if math.prod(sizes) > most:
            raise BurstError(
                f"the OME metadata of {path} tell of {' x '.join(map(str, sizes))} pixels (TCZYX), where its pages "
                f"have {' x '.join(map(str, file.pages.first.shape))}; export it again"
            )


def _check_whole(path: Path, file: tifffile.TiffFile) -> None:
    """Refuse a file that points to pages or pixels that are not in it, or that cannot hold what it claims.

    tifffile logs this at most, and reads what is left as if it were the whole.
    """
    if _lacks_pages(file) or any(_lacks_pixels(path, series) for series in file.series):
        raise BurstError(f"{path} is cut short, or parts of it are missing; copy or export it again")


def _lacks_pages(file: tifffile.TiffFile) -> bool:
    # A further page, of which nothing could be read.
    return _following(file, file.pages[len(file.pages) - 1].offset) != 0


def _lacks_pixels(path: Path, series: tifffile.TiffPageSeries) -> bool:
    if series.dataoffset is not None:  # pages follow one another, so that not each need be looked at
        return bool(series.dataoffset + series.nbytes > series.keyframe.parent.filehandle.size)
    stored = 0
    for page in series.pages:
        if page is None or _end_of(page) > page.parent.filehandle.size:
            return True
        if 0 in page.databytecounts:  # a strip or tile that was never written, and would be black
            return True
        stored += sum(page.databytecounts)
    check_packed(path, series.nbytes, stored)
    return False


def _end_of(page: Any) -> int:
    return max((start + length for start, length in zip(page.dataoffsets, page.databytecounts, strict=True)), default=0)


class _OpenTiff:
    """A TIFF file that is open, and how its frames lie in pages."""

    def __init__(self, path: Path) -> None:
        self.file = tifffile.TiffFile(path)
        try:
            _check_pages(path, self.file)
            first, *others = self.file.series
            # An OME file may hold further images, of which the first is the one.
            self._series = [first] if self.file.is_ome else [first, *others]
            if any((one.shape, one.dtype, one.axes) != (first.shape, first.dtype, first.axes) for one in self._series):
                shapes = ", ".join(dict.fromkeys(str(series.shape) for series in self.file.series))
                raise BurstError(
                    f"{path} holds pages of different sizes or types, {shapes}; keep the frames of one size"
                )
            self.keyframe = first.keyframe
            self.dtype: np.dtype[Any] = first.dtype
            split = len(first.shape) - len(self.keyframe.shape)
            self._pages = int(np.prod(first.shape[:split], dtype=int))
            self._is_paged = first.shape[split:] == self.keyframe.shape and len(first.pages) == self._pages
            if not self._is_paged:
                split, self._pages = 0, 1
            several = len(self._series) > 1
            self.leading = (len(self._series),) * several + first.shape[:split]
            self.leading_axes = "T" * several + first.axes[:split]
            self.part, self.part_axes = first.shape[split:], first.axes[split:]
            sizes = dict(zip(self.part_axes, self.part, strict=True))
            check_frame(*(sizes.get(axis, 1) for axis in "YXS"))
        except BaseException:
            self.file.close()
            raise

    def close(self) -> None:
        self.file.close()

    def read(self, number: int) -> NDArray[Any]:
        """Return a page, or all there is where frames do not lie in pages."""
        series, page = self._series[number // self._pages], number % self._pages
        if not self._is_paged:
            return np.asarray(series.asarray())
        if series.dataoffset is None:
            described = series.pages[page]
            if described is None:
                raise ValueError(f"page {page} is missing")
            return np.asarray(described.asarray())
        # Without compression, pages follow one another, and some programs describe the first of them alone.
        size = int(np.prod(self.part, dtype=int))
        stored = self.dtype.newbyteorder(self.file.byteorder)
        self.file.filehandle.seek(series.dataoffset + page * size * stored.itemsize)
        pixels = np.frombuffer(self.file.filehandle.read(size * stored.itemsize), stored)
        return pixels.astype(self.dtype).reshape(self.part)


@dataclass(frozen=True, slots=True, eq=False)
class _Pages:
    """Reads the pages of a TIFF file, as they show light."""

    path: Path
    handle: Handle[_OpenTiff]

    def __call__(self, number: int) -> NDArray[Any]:
        try:
            with self.handle.use() as tiff:
                return _light(tiff.read(number), tiff.part_axes, tiff.keyframe)[0]
        except Exception as error:  # as in `read_tiff`
            raise BurstError(f"{self.path} cannot be read as TIFF ({error}); copy or export it again") from error


def _light(pixels: NDArray[Any], axes: str, page: Any) -> tuple[NDArray[Any], str]:
    """Return colours for the indices of a palette, and leave out alpha channels, which are no light."""
    if page.photometric == tifffile.PHOTOMETRIC.PALETTE and page.colormap is not None:
        return np.moveaxis(page.colormap[:, pixels], 0, -1), axes + "S"
    alphas = sum(sample in (1, 2) for sample in page.extrasamples)
    if alphas and "S" in axes:
        samples = axes.index("S")
        pixels = np.delete(pixels, range(pixels.shape[samples] - alphas, pixels.shape[samples]), axis=samples)
        if pixels.shape[samples] == 1:
            pixels, axes = pixels.squeeze(samples), axes.replace("S", "")
    return pixels, axes


def _described(file: tifffile.TiffFile, count: int) -> dict[str, Any]:
    """Return what is said of `count` frames; nothing where what is said makes no sense."""
    try:
        if file.is_ome and file.ome_metadata:
            return _from_ome(file.ome_metadata, count)
        return _from_imagej(file, count)
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        logger.warning("ignoring the metadata of %s, which cannot be read: %r", file.filename, error)
        return {}


def _from_ome(document: str, count: int) -> dict[str, Any]:
    image = tifffile.xml2dict(document)["OME"]["Image"]
    pixels = (image[0] if isinstance(image, list) else image)["Pixels"]
    described: dict[str, Any] = {}
    if "PhysicalSizeX" in pixels and "PhysicalSizeY" in pixels:
        described["pixel_size"] = (float(pixels["PhysicalSizeY"]), float(pixels["PhysicalSizeX"]))
        described["unit"] = pixels.get("PhysicalSizeXUnit", "µm")
    names = [channel.get("Name") for channel in _as_list(pixels.get("Channel"))]
    if names and None not in names:
        described["channel_names"] = tuple(str(name) for name in names)
    planes = [plane for plane in _as_list(pixels.get("Plane")) if "DeltaT" in plane]
    deltas = {(plane["TheT"], plane["TheZ"]): _seconds(plane, "DeltaT") for plane in reversed(planes)}
    if len(deltas) == count:
        described["times"] = [deltas[place] for place in sorted(deltas)]
    elif "TimeIncrement" in pixels:
        described["times"] = [index * _seconds(pixels, "TimeIncrement") for index in range(count)]
    return described


def _seconds(element: dict[str, Any], name: str) -> float:
    return float(element[name]) * _SECONDS[element.get(name + "Unit", "s")]


def _from_imagej(file: tifffile.TiffFile, count: int) -> dict[str, Any]:
    known = file.imagej_metadata or {}
    described: dict[str, Any] = {}
    tags = file.pages.first.tags
    if known.get("unit") and "XResolution" in tags and "YResolution" in tags:
        y, x = (tags[name].value for name in ("YResolution", "XResolution"))
        described["pixel_size"] = (y[1] / y[0], x[1] / x[0])
        # ImageJ escapes the micro sign.
        described["unit"] = str(known["unit"]).replace("\\u00B5", "µ")
    if known.get("finterval"):
        described["times"] = [index * float(known["finterval"]) for index in range(count)]
    return described


def _as_list(value: Any) -> list[Any]:
    """Return what xml2dict gives for an element that may stand once, often or never."""
    if value is None:
        return []
    return value if isinstance(value, list) else [value]
