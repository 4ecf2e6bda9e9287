"""What a file may be and claim, seen before anything is read or memory is taken for it."""

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from napari_fiberburst.errors import BurstError, FiberBurstError

# Pixels as they are recorded are packed 20:1 at most, by lossy JPEG 85:1; what is packed tighter, and takes more memory
# than this, says the same many times over.
_TIGHTEST, _ALWAYS = 200, 2**28


def check_file(path: Path, kind: type[FiberBurstError] = BurstError) -> None:
    """Refuse what is no file with something in it: a pipe or a device would be waited for, or read without end.

    Raises
    ------
    FiberBurstError
        Of `kind`: it is no regular file, or is empty.
    OSError
        There is nothing, or it may not be looked at.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        what = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or a device"
        raise kind(f"{path} is {what}, not a file; write what it gives into a file, and open that")
    if status.st_size == 0:
        raise kind(f"{path} is empty; copy or export it again")


def check_packed(path: Path, claimed: int, stored: int, kind: type[FiberBurstError] = BurstError) -> None:
    """Refuse what would take far more memory than its file has bytes.

    Parameters
    ----------
    path : Path
        The file.
    claimed, stored : int
        Bytes in memory, and in the file.
    kind : type
        Of the error.

    Raises
    ------
    FiberBurstError
        Of `kind`: more than 200 times as many, and more than 256 MiB.
    """
    if claimed > max(_ALWAYS, _TIGHTEST * stored):
        raise kind(
            f"{path} claims {claimed / 2**20:,.0f} MiB of pixels in {stored / 2**10:,.0f} KiB; expected {_TIGHTEST} "
            "times its size at most: it is damaged, or was made to do harm; export it again"
        )


@contextmanager
def open_arrays(path: str | Path, kind: type[FiberBurstError] = BurstError) -> Iterator[Any]:
    """Open an archive of numpy arrays that holds what it claims; an array is unpacked when it is asked for.

    Raises
    ------
    FiberBurstError
        Of `kind`, as `check_file` and `check_packed`.
    Exception
        It is damaged, or no such archive: zipfile, zlib and numpy each have their own.
    """
    file = Path(path)
    check_file(file, kind)
    with ZipFile(file) as archive:
        check_packed(file, sum(member.file_size for member in archive.infolist()), file.stat().st_size, kind)
    with np.load(file, allow_pickle=False) as arrays:
        yield arrays
