"""Frames that lie in a file each."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.bounds import check_file
from napari_fiberburst.io.lazy import Parts
from napari_fiberburst.io.recording import Recording
from napari_fiberburst.io.tiff import TIFF_ENDINGS, read_tiff

IMAGE_ENDINGS = (".png", *TIFF_ENDINGS)
# Where the bit depth stands in the header of every PNG file.
_PNG_BIT_DEPTH = 24


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that counts: frame2 stands before frame10."""
    parts = re.split(r"(\d+)", str(path))
    return [(int(part), "") if part.isdigit() else (-1, part.lower()) for part in parts]


def read_images(paths: list[Path], source: str) -> Recording:
    """Open files that hold one frame each, in natural order of their names; each is read when it is wanted.

    Raises
    ------
    BurstError
        No files, or the first of them is no image.
    """
    if not paths:
        raise BurstError(f"{source} holds no frames; expected files ending in {', '.join(IMAGE_ENDINGS)}")
    ordered = tuple(sorted(paths, key=natural_key))
    first = _read_frame(ordered[0])
    pixels = Parts(_Images(ordered, first.shape, first.dtype), (len(ordered),), first.shape, first.dtype)
    return Recording(pixels=pixels, axes="TYX" if first.ndim == 2 else "TYXC")


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """Reads images that are frames of one recording."""

    paths: tuple[Path, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def __call__(self, number: int) -> NDArray[Any]:
        frame = _read_frame(self.paths[number])
        if (frame.shape, frame.dtype) != (self.shape, self.dtype):
            raise BurstError(
                f"all frames need one size and type; {self.paths[number]} has {frame.shape} {frame.dtype} where the "
                f"first has {self.shape} {self.dtype}; crop or convert it, or leave it out"
            )
        return frame


def _read_frame(path: Path) -> NDArray[Any]:
    return _read_png(path) if path.suffix.lower() == ".png" else _read_page(path)


def read_image(path: str | Path) -> NDArray[Any]:
    """Read one image, (H, W) or (H, W, C), from a PNG, TIFF or npy file; or the several of a stack, (T, H, W[, C]).

    Raises
    ------
    BurstError
        It is not there, or no image.
    """
    file = Path(path)
    endings = (*IMAGE_ENDINGS, ".npy")
    if file.suffix.lower() in endings and not file.exists():
        raise BurstError(f"there is no {path}; give an image that is there")
    if file.suffix.lower() not in endings or not file.is_file():
        raise BurstError(f"expected the file of an image, ending in {', '.join(endings)}; got {path}")
    try:
        if file.suffix.lower() == ".npy":
            # Mapped first, because only so is what it claims held to what it has.
            return np.array(np.load(file, mmap_mode="r", allow_pickle=False))
        if file.suffix.lower() == ".png":
            return _read_png(file)
    except BurstError:
        raise
    except (OSError, ValueError, EOFError) as error:
        raise BurstError(f"{path} cannot be read as an image ({error}); export it again") from error
    recording = read_tiff(file)
    axes = (recording.axes or "").replace("S", "C")
    order = [axes.index(axis) for axis in "TYXC" if axis in axes]
    if len(order) != len(axes) or not {"Y", "X"} <= set(axes):
        raise BurstError(f"{path} must hold an image or a stack of them; got axes {axes}; save it with axes TYXC")
    return np.transpose(np.asarray(recording.pixels), order)


def _read_page(path: Path) -> NDArray[Any]:
    """Return the one frame of a TIFF file, (H, W) or (H, W, C)."""
    recording = read_tiff(path)
    axes = (recording.axes or "").replace("S", "C")
    frame = np.asarray(recording.pixels)
    if "T" in axes and frame.shape[axes.index("T")] == 1:
        frame, axes = frame.squeeze(axes.index("T")), axes.replace("T", "")
    if axes not in ("YX", "YXC", "CYX"):
        raise BurstError(f"{path} must hold one frame, got shape {frame.shape} with axes {axes}; open it by itself")
    return np.moveaxis(frame, 0, 2) if axes == "CYX" else frame


def _read_png(path: Path) -> NDArray[Any]:
    check_file(path)
    try:
        with Image.open(path) as image:
            depth = path.read_bytes()[_PNG_BIT_DEPTH]
            if depth == 16 and not image.mode.startswith("I"):
                raise BurstError(f"{path} has 16 bits per colour, of which only 8 could be read; save it as TIFF")
            # A palette stands for colours, and an alpha channel is no light.
            mode = {"P": "RGB", "RGBA": "RGB", "LA": "L"}.get(image.mode, image.mode)
            return np.asarray(image.convert(mode))
    except BurstError:
        raise
    except Exception as error:  # Pillow fails on damaged files in many ways
        raise BurstError(f"{path} cannot be read as an image ({error}); replace it or leave it out") from error
