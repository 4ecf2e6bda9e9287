"""Open recordings of any length, from whatever they lie in; frames are read when they are wanted."""

import glob
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Acquisition, check_dtype, check_size, choose_levels
from napari_fiberburst.data.layout import Layout
from napari_fiberburst.data.source import FrameSource, Reader
from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.archive import ARCHIVE_ENDINGS, read_archive
from napari_fiberburst.io.bounds import check_file
from napari_fiberburst.io.folder import IMAGE_ENDINGS, natural_key, read_images
from napari_fiberburst.io.frames import chosen_frames
from napari_fiberburst.io.recording import Recording
from napari_fiberburst.io.tiff import TIFF_ENDINGS, read_tiff
from napari_fiberburst.io.video import read_video
from napari_fiberburst.io.video_container import VIDEO_ENDINGS
from napari_fiberburst.io.zarr import is_zarr, read_zarr

_FORMATS = (
    "a TIFF stack (.tif, .tiff, .ome.tif), a video (.avi, .mp4, .mkv, .mpg and others), a folder of PNG or TIFF "
    "frames, a pattern such as 'frames/*.png', a simulated burst (.burst), a .npz file, or OME-Zarr (.zarr)"
)
# Levels and fingerprints go by so many frames, spread over the recording.
_SAMPLED, _STAMPED = 16, 4
# So many frames at most are asked of an array at a time, so that a chunk of several frames is read once.
_AT_ONCE = 32


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Unread:
    """The frames of a recording before any of them is read, and what is known by then.

    Attributes
    ----------
    reader : Reader
        Reads them.
    shape : tuple of int
        Frames, height, width and channels.
    axes : str
        "TYX" or "TYXC".
    dtype : numpy.dtype
        Of the pixels.
    metadata : dict
        Channel names, pixel size, unit and times, where they are known.
    levels : (float or None, float or None)
        Black and white, where the file gives them.
    name : str
        How the recording is called.
    files : tuple of Path
        Where it lies; empty for arrays.
    """

    reader: Reader
    shape: tuple[int, int, int, int]
    axes: str
    dtype: np.dtype[Any]
    metadata: dict[str, Any]
    levels: tuple[float | None, float | None]
    name: str
    files: tuple[Path, ...] = ()

    @property
    def is_video(self) -> bool:
        """Whether it lies in video files."""
        return any(file.suffix.lower() in VIDEO_ENDINGS for file in self.files)

    def spread(self, most: int) -> list[int]:
        """Return the numbers of some frames, spread over the recording, the first and the last among them."""
        return sorted({round(place) for place in np.linspace(0, self.shape[0] - 1, most).tolist()})


def open_recording(
    recording: Any,
    *,
    axes: str | None = None,
    black_level: float | None = None,
    white_level: float | None = None,
    frames: str | slice | None = None,
) -> FrameSource:
    """Open a recording of any length. Its frames are read when they are wanted.

    Parameters
    ----------
    recording : str, Path, list of these, or array
        A video (needs the extra ``recordings``); a TIFF of any size; a folder of PNG or TIFF frames, or of videos; a
        pattern such as ``frames/*.png``, taken in natural order (2 before 10); OME-Zarr; an archive as `read_burst`
        takes it. Several files, in the order given, are one recording. Or a numpy or dask array, or anything else with
        `shape`, `dtype` and `__getitem__`.
    axes : str, optional
        Order of the axes, such as "CTYX", where the file does not say it or is wrong.
    black_level, white_level : float, optional
        Intensities that become 0 and 1. For integers the default is 0 and the least full scale of 8, 10, 12 and so on
        up to 32 bits that holds all values of 16 frames that are spread over the recording; for floats 0 and 1, widened
        where those frames have values beyond. What lies beyond the levels is clipped.
    frames : str or slice, optional
        These frames alone, such as "100:120" or "100:2000:5".

    Returns
    -------
    FrameSource
        With channel names, pixel size, unit and frame times where the file has them.

    Raises
    ------
    BurstError
        There is nothing at the path, or it cannot be read; the message says what to do.

    Examples
    --------
    >>> import numpy as np
    >>> open_recording(np.zeros((1000, 20, 30), np.uint8), frames="100:120")
    FrameSource(the array: 20 frames of 20 x 30, 1 channels, uint8)
    """
    if isinstance(recording, FrameSource):
        source = recording
    else:
        with about(recording):
            unread = open_unread(recording, axes)
            black, white = _levels(unread, black_level, white_level)
            source = FrameSource(
                acquisition=Acquisition(
                    shape=unread.shape,
                    axes=unread.axes,
                    dtype=unread.dtype,
                    black_level=black,
                    white_level=white,
                    **unread.metadata,
                ),
                reader=unread.reader,
                name=unread.name,
                fingerprint=_fingerprint(unread, (unread.axes, unread.shape, black, white)),
            )
    numbers = chosen_frames(frames, len(source), source.name)
    return source if numbers == range(len(source)) else source.take(numbers)


def open_unread(recording: Any, axes: str | None = None) -> Unread:
    """Open what `open_recording` takes, and read no frame of it that need not be.

    Raises
    ------
    BurstError
        As `open_recording`.
    """
    if isinstance(recording, str | Path):
        found, files = _open(Path(recording))
        return found if isinstance(found, Unread) else _unread(found, axes, str(recording), files)
    if isinstance(recording, list | tuple) and recording and all(isinstance(item, str | Path) for item in recording):
        paths = [Path(item) for item in recording]
        if all(path.suffix.lower() == ".png" for path in paths):
            return _unread(read_images(paths, "the list"), axes, _several(paths), tuple(paths))
        return _joined(paths, axes)
    if not all(hasattr(recording, name) for name in ("shape", "dtype", "__getitem__")):
        raise BurstError(
            "a recording is a path, a list of paths, or an array with shape, dtype and slices; got "
            f"{type(recording).__name__}; make a list of frames one array by numpy.stack"
        )
    return _unread(Recording(pixels=recording), axes, "the array", ())


@contextmanager
def about(recording: Any) -> Iterator[None]:
    """Let errors that are raised meanwhile name the recording's path, and be of our kind."""
    path = str(recording) if isinstance(recording, str | Path) else ""
    try:
        yield
    except BurstError as error:
        raise error if path in str(error) else BurstError(f"{path}: {error}") from error
    except OSError as error:
        raise BurstError(
            f"{path or error.filename} cannot be opened ({error}); check its name and its permissions"
        ) from error


def _open(path: Path) -> tuple[Recording | Unread, tuple[Path, ...]]:
    """Return what lies at a path, and the files that it lies in."""
    if glob.has_magic(str(path)) and not path.exists():
        return _in_files([Path(name) for name in glob.glob(str(path))], str(path))
    if not path.exists():
        raise BurstError(f"there is no {path}; expected {_FORMATS}")
    if path.is_dir():
        if is_zarr(path):
            files = [item for item in path.rglob("*") if not item.is_dir()]
            for file in files:
                check_file(file)
            return read_zarr(path), tuple(files)
        # A dot in front hides a file: those are some system's notes on an image, not images.
        files = [item for item in path.iterdir() if item.is_file() and item.name[0] != "."]
        known = [item for item in files if item.suffix.lower() in IMAGE_ENDINGS]
        return _in_files(
            known or [item for item in files if item.suffix.lower() in VIDEO_ENDINGS], f"the folder {path}"
        )
    for endings, read in ((TIFF_ENDINGS, read_tiff), (ARCHIVE_ENDINGS, read_archive), (VIDEO_ENDINGS, read_video)):
        if path.suffix.lower() in endings:
            return read(path), (path,)
    raise BurstError(f"{path} is of no kind that can be read; expected {_FORMATS}")


def _in_files(files: list[Path], source: str) -> tuple[Recording | Unread, tuple[Path, ...]]:
    """Return images as a frame each, and videos as one recording."""
    files = sorted(files, key=natural_key)
    if files and all(file.suffix.lower() in VIDEO_ENDINGS for file in files):
        return _joined(files, None), tuple(files)
    return read_images(files, source), tuple(files)


def _unread(recording: Recording, axes: str | None, name: str, files: tuple[Path, ...]) -> Unread:
    layout = Layout.of(tuple(recording.pixels.shape), axes or recording.axes)
    dtype = np.dtype(recording.pixels.dtype).newbyteorder("=")
    check_size(layout.shape)
    check_dtype(dtype)
    metadata = recording.usable_metadata(axes)
    if "times" in metadata:
        metadata["times"] = np.array(metadata["times"], np.float64)
    return Unread(
        reader=_Slices(recording.pixels, layout, dtype, name),
        shape=layout.shape,
        axes=layout.axes,
        dtype=dtype,
        metadata=metadata,
        levels=(recording.black_level, recording.white_level),
        name=name,
        files=files,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Slices:
    """Reads frames as slices of an array, which may read them from a file."""

    pixels: Any
    layout: Layout
    dtype: np.dtype[Any]
    name: str

    def __call__(self, numbers: Sequence[int]) -> NDArray[np.generic]:
        wanted, places = np.unique(np.asarray(numbers, dtype=int), return_inverse=True)
        frames = np.empty((len(wanted), *self.layout.shape[1:]), self.dtype)
        first = 0
        while first < len(wanted):
            last = first + 1
            while last < min(len(wanted), first + _AT_ONCE) and wanted[last] == wanted[last - 1] + 1:
                last += 1
            frames[first:last] = self._read(int(wanted[first]), int(wanted[last - 1]) + 1)
            first = last
        return frames if np.array_equal(places, np.arange(len(frames))) else frames[places]

    def _read(self, start: int, stop: int) -> NDArray[Any]:
        try:
            return self.layout.take(self.pixels, start, stop)
        except BurstError:
            raise
        except Exception as error:  # each kind of array has its own
            raise BurstError(
                f"frames {start} to {stop - 1} of {self.name} cannot be read ({type(error).__name__}: {error}); check "
                "the file, or leave them out"
            ) from error


def _several(paths: Sequence[Path]) -> str:
    return f"{paths[0]} and {len(paths) - 1} more" if len(paths) > 1 else str(paths[0])


def _joined(paths: list[Path], axes: str | None) -> Unread:
    """Return the frames of several files, one after the other."""
    parts = []
    for path in paths:
        with about(path):
            parts.append(open_unread(path, axes))
    first = parts[0]
    for part in parts:
        if (part.shape[1:], part.axes, part.dtype) != (first.shape[1:], first.axes, first.dtype):
            raise BurstError(
                f"files of one recording need frames of one size and type; {part.name} has {_said(part)} where "
                f"{first.name} has {_said(first)}; open it by itself, or crop or convert it"
            )
    count = sum(part.shape[0] for part in parts)
    metadata = {key: value for key, value in first.metadata.items() if key != "times"}
    times = [part.metadata["times"] for part in parts if "times" in part.metadata]
    if len(times) == len(parts):
        metadata["times"] = _one_after_the_other(times)
    return Unread(
        reader=_Joined(tuple(part.reader for part in parts), tuple(part.shape[0] for part in parts)),
        shape=(count, *first.shape[1:]),
        axes=first.axes,
        dtype=first.dtype,
        metadata=metadata,
        levels=first.levels,
        name=_several(paths),
        files=tuple(file for part in parts for file in part.files),
    )


def _said(part: Unread) -> str:
    return f"{part.shape[1]} x {part.shape[2]}, {part.shape[3]} channels, {part.dtype}"


def _one_after_the_other(times: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the times of frames in several files, moved behind the file before where a clock begins anew."""
    joined = [times[0]]
    for following in times[1:]:
        before = joined[-1]
        if following[0] <= before[-1]:
            interval = np.median(np.diff(before)) if len(before) > 1 else 0.0
            following = following - following[0] + before[-1] + interval
        joined.append(following)
    return np.concatenate(joined)


@dataclass(frozen=True, slots=True, eq=False)
class _Joined:
    """Reads the frames of several files as if they were in one."""

    readers: tuple[Reader, ...]
    counts: tuple[int, ...]

    def __call__(self, numbers: Sequence[int]) -> NDArray[np.generic]:
        wanted = np.asarray(numbers, dtype=int)
        ends = np.cumsum(self.counts)
        of = np.searchsorted(ends, wanted, side="right")
        parts = {
            int(part): self.readers[part]((wanted[of == part] - (ends[part] - self.counts[part])).tolist())
            for part in np.unique(of)
        }
        if len(parts) == 1:
            return next(iter(parts.values()))
        one = next(iter(parts.values()))
        frames = np.empty((len(wanted), *one.shape[1:]), one.dtype)
        for part, read in parts.items():
            frames[of == part] = read
        return frames


def _levels(unread: Unread, black: float | None, white: float | None) -> tuple[float, float]:
    """Return the levels asked for, or else those of the file, or else what some frames suggest."""
    known_black, known_white = unread.levels
    black = known_black if black is None else black
    white = known_white if white is None else white
    low, high = 0.0, 255.0
    if unread.dtype != np.uint8 and (black is None or white is None):
        ranges = [_range(unread.reader([number])) for number in unread.spread(_SAMPLED)]
        low, high = min(least for least, _ in ranges), max(most for _, most in ranges)
    return choose_levels(unread.dtype, low, high, black, white)


def _range(values: NDArray[Any]) -> tuple[float, float]:
    """Return the least and the greatest of the values that are finite."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)


def _fingerprint(unread: Unread, asked: tuple[Any, ...]) -> str:
    told = sha256(repr(asked).encode())
    for file in unread.files:
        status = file.stat()
        told.update(f"{file.name} {status.st_size} {status.st_mtime_ns}".encode())
    if not unread.files:
        for number in unread.spread(_STAMPED):
            told.update(np.ascontiguousarray(unread.reader([number])).tobytes())
    return told.hexdigest()
