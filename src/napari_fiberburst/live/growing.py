"""A folder of frames or a file that another program writes to, watched while it grows."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any

from numpy.typing import NDArray

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io import open_recording
from napari_fiberburst.io.folder import IMAGE_ENDINGS, natural_key, read_image
from napari_fiberburst.io.zarr import is_zarr
from napari_fiberburst.live.clocks import Clock, RealClock
from napari_fiberburst.live.sources import Latest

# Seconds between looks for new frames, and for how long a frame that cannot be read may still be written to.
_POLL, _PATIENCE = 0.05, 2.0


class Growing:
    """The frames that are added to a folder or a file from now on, the newest one that is there before them.

    Parameters
    ----------
    path : str or Path
        A folder to which PNG or TIFF files of a frame each are added, or a TIFF or OME-Zarr image that grows.
    clock : Clock, optional
        Default, the machine's.

    Attributes
    ----------
    clock : Clock
        That the times of frames are read on, when they are found.

    Raises
    ------
    BurstError
        There is no such path, or no image that can be opened.
    """

    def __init__(self, path: str | Path, clock: Clock | None = None) -> None:
        self.clock: Clock = RealClock() if clock is None else clock
        place = Path(path)
        if not place.exists():
            raise BurstError(f"{path} is not there; choose a folder, a TIFF file or an OME-Zarr image that grows")
        self._look = _Folder(place) if place.is_dir() and not is_zarr(place) else _File(place)
        self._next = max(0, self._look.count() - 1)
        self._first = self._next
        self._closed = Event()

    def latest(self, n: int = 1) -> Latest:
        """Wait for the next frame, and return up to n of those that have come.

        One that cannot be read for two seconds is passed over.

        Raises
        ------
        BurstError
            The folder or file is gone.
        """
        before, since = self._next, self.clock.now()
        while not self._closed.is_set():
            come = self._look.count()
            first = max(self._next, come - n)
            frames = self._frames(range(first, come))
            if frames:
                self._next = first + len(frames)
                return self._as_latest(frames, first, first - before)
            if first == come:
                since = self.clock.now()
            elif self.clock.now() - since > _PATIENCE:
                self._next, since = first + 1, self.clock.now()
                continue
            self.clock.wait(_POLL)
        return self._as_latest([], self._next, 0)

    def close(self) -> None:
        """Look no more."""
        self._closed.set()

    def _frames(self, numbers: range) -> list[NDArray[Any]]:
        """Return frames, up to the first that whoever writes it has not finished."""
        frames: list[NDArray[Any]] = []
        with suppress(BurstError):
            frames.extend(map(self._look.frame, numbers))
        return frames

    def _as_latest(self, frames: list[NDArray[Any]], first: int, dropped: int) -> Latest:
        return Latest.of(frames, first - self._first, self.clock.now(), dropped)


class _Folder:
    """A folder of files with a frame each, in natural order of their names, which is that of their time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._names: list[Path] = []
        self._known: set[str] = set()

    def count(self) -> int:
        """Return how many frames there are."""
        try:
            # A dot in front hides a file that is not yet what its ending says.
            names = [name for name in os.listdir(self._path) if name[0] != "." and name not in self._known]
        except OSError as error:
            raise BurstError(f"{self._path} is gone ({error}); start again when it is there") from error
        self._known.update(names)
        images = [self._path / name for name in names if name.lower().endswith(IMAGE_ENDINGS)]
        self._names.extend(sorted(images, key=natural_key))
        return len(self._names)

    def frame(self, number: int) -> NDArray[Any]:
        """Return one, (H, W, C)."""
        frame = read_image(self._names[number])
        if frame.ndim not in (2, 3):
            raise BurstError(f"{self._names[number]} holds several frames; write each to a file of its own")
        return frame if frame.ndim == 3 else frame[..., None]


class _File:
    """One file or OME-Zarr image, opened anew whenever it has changed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._told: object = None
        self._count = 0
        self._read: Callable[[int], NDArray[Any]] | None = None

    def count(self) -> int:
        """Return how many frames there are."""
        told = _changed(self._path)
        if told != self._told:
            try:
                recording = open_recording(self._path, white_level=1)
            except BurstError:
                if self._read is None:
                    raise
                return self._count  # between two writes
            self._told, self._count = told, len(recording)
            self._read = lambda number: recording.recorded([number])[0]
        return self._count

    def frame(self, number: int) -> NDArray[Any]:
        """Return one, (H, W, C)."""
        assert self._read is not None
        return self._read(number)


def _changed(path: Path) -> tuple[tuple[int, int], ...]:
    """Return what is another where an image has grown: size and time of its file, or of those that tell its shape."""
    files = sorted([*path.glob("**/zarr.json"), *path.glob("**/.zarray")]) if path.is_dir() else [path]
    try:
        return tuple((file.stat().st_size, file.stat().st_mtime_ns) for file in files)
    except OSError as error:
        raise BurstError(f"{path} is gone ({error}); start again when it is there") from error
