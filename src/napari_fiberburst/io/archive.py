"""Frames in an archive of numpy arrays, such as a simulated burst."""

from pathlib import Path
from typing import Any

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.bounds import open_arrays
from napari_fiberburst.io.recording import Recording

# Of a simulated burst with its truth: numpy's archive, under a name that no other reader of napari's claims. Earlier
# versions wrote .npz, which napari opens by itself, and not as a burst.
SIMULATED_ENDING = ".burst"
ARCHIVE_ENDINGS = (SIMULATED_ENDING, ".npz")

_SCALARS = ("axes", "black_level", "white_level")


def read_archive(path: Path) -> Recording:
    """Read an archive's array "frames", or the only one that it has.

    Raises
    ------
    BurstError
        It has several arrays and none of that name, is no archive, or would take far more memory than it has bytes.
    """
    try:
        with open_arrays(path) as arrays:
            names = list(arrays)
            if "frames" not in names and len(names) != 1:
                raise BurstError(f"{path} needs an array named 'frames'; it has {', '.join(names) or 'none'}")
            name = "frames" if "frames" in names else names[0]
            known: dict[str, Any] = {key: arrays[key].item() for key in _SCALARS if key in names}
            if not isinstance(known.get("axes", ""), str):
                raise BurstError(f'{path} must give its axes as text, such as "CTYX"; got {known["axes"]!r}')
            return Recording(pixels=arrays[name], **known)
    except BurstError:
        raise
    except Exception as error:  # a damaged archive fails in zipfile, zlib or numpy, each in its own way
        raise BurstError(f"{path} cannot be read as npz ({error}); save it again with numpy.savez") from error
