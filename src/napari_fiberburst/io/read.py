"""Open a burst from whatever it lies in."""

import glob
from pathlib import Path
from typing import Any

import numpy as np

from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.folder import IMAGE_ENDINGS, read_images
from napari_fiberburst.io.recording import Recording
from napari_fiberburst.io.tiff import TIFF_ENDINGS, read_tiff
from napari_fiberburst.io.zarr import is_zarr, read_zarr

_FORMATS = (
    "a TIFF stack (.tif, .tiff, .ome.tif), a folder of PNG or TIFF frames, a pattern such as 'frames/*.png', "
    "a simulated burst (.burst), a .npz file, or OME-Zarr (.zarr)"
)
# Of a simulated burst with its truth: numpy's archive, under a name that no other reader of napari's claims. Earlier
# versions wrote .npz, which napari opens by itself, and not as a burst.
SIMULATED_ENDING = ".burst"
ARCHIVE_ENDINGS = (SIMULATED_ENDING, ".npz")

_NPZ_SCALARS = ("axes", "black_level", "white_level")


def read_burst(
    path: str | Path,
    *,
    axes: str | None = None,
    black_level: float | None = None,
    white_level: float | None = None,
) -> Burst:
    """Read a burst from a file, a folder or a pattern.

    Parameters
    ----------
    path : str or Path
        A multi-page TIFF or OME-TIFF; a folder of PNG or TIFF frames, or a pattern such as ``frames/*.png``, taken in
        natural order (2 before 10); a ``.burst`` file of a simulated burst, or a ``.npz`` file with only one
        array, or with an array "frames" (and, where they are known, "axes", "black_level" and "white_level"); an
        OME-Zarr image (needs the extra ``zarr``).
    axes : str, optional
        Order of the axes, where the file does not say it or is wrong.
    black_level, white_level : float, optional
        As in `Burst`.

    Returns
    -------
    Burst
        With channel names, pixel size, unit and frame times where the file has them.

    Raises
    ------
    BurstError
        There is nothing at the path, it cannot be read, or its frames are no burst.
    """
    try:
        recording = _open(Path(path))
        return Burst(
            recording.pixels,
            axes=axes or recording.axes,
            black_level=recording.black_level if black_level is None else black_level,
            white_level=recording.white_level if white_level is None else white_level,
            **recording.usable_metadata(axes),
        )
    except BurstError as error:
        raise error if str(path) in str(error) else BurstError(f"{path}: {error}") from error
    except OSError as error:
        raise BurstError(f"{path} cannot be opened ({error}); check its name and its permissions") from error


def _open(path: Path) -> Recording:
    if glob.has_magic(str(path)) and not path.exists():
        found = [Path(name) for name in glob.glob(str(path))]
        return read_images(found, str(path))
    if not path.exists():
        raise BurstError(f"there is no {path}; expected {_FORMATS}")
    if path.is_dir():
        if is_zarr(path):
            return read_zarr(path)
        # A dot in front hides a file: those are some system's notes on an image, not images.
        found = [item for item in path.iterdir() if item.suffix.lower() in IMAGE_ENDINGS and item.name[0] != "."]
        return read_images([item for item in found if item.is_file()], f"the folder {path}")
    if path.suffix.lower() in TIFF_ENDINGS:
        return read_tiff(path)
    if path.suffix.lower() in ARCHIVE_ENDINGS:
        return _read_archive(path)
    raise BurstError(f"{path} is of no kind that can be read; expected {_FORMATS}")


def _read_archive(path: Path) -> Recording:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            names = list(arrays)
            if "frames" not in names and len(names) != 1:
                raise BurstError(f"{path} needs an array named 'frames'; it has {', '.join(names) or 'none'}")
            name = "frames" if "frames" in names else names[0]
            known: dict[str, Any] = {key: arrays[key].item() for key in _NPZ_SCALARS if key in names}
            if not isinstance(known.get("axes", ""), str):
                raise BurstError(f'{path} must give its axes as text, such as "CTYX"; got {known["axes"]!r}')
            return Recording(pixels=arrays[name], **known)
    except BurstError:
        raise
    except Exception as error:  # a damaged archive fails in zipfile, zlib or numpy, each in its own way
        raise BurstError(f"{path} cannot be read as npz ({error}); save it again with numpy.savez") from error
