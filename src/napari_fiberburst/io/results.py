"""Results out: an image with its provenance beside it, or the fitted networks.

Every file is written whole or not at all.
"""

import json
import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from glob import has_magic
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from secrets import token_hex
from typing import IO, Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.bounds import open_arrays
from napari_fiberburst.io.plain import parse_json, plain_scalar, read_json

IMAGE_ENDINGS = (".ome.tif", ".ome.tiff", ".tif", ".tiff")
# All that a result has; no other program has files of this name.
MODEL_ENDING = ".fiberburst"
CHECKPOINT_ENDING = ".checkpoint"
_PARTIAL = ".part"
REPRESENTATION_ENDING = ".npz"
PICTURE_ENDING = ".png"
# Those of OME's schema that a bundle's pixels could be given in; others stand in the JSON alone.
_OME_UNITS = ("pm", "Å", "nm", "µm", "mm", "cm", "m", "in", "pixel")
SOFTWARE = "napari-fiberburst"
_NAMED_PACKAGES = (SOFTWARE, "numpy", "scipy", "torch", "scikit-image", "tifffile")


def check_output(path: str | Path, source: Path | None = None) -> Path:
    """Refuse a path that a result should not be written to; before a long run rather than after it.

    Parameters
    ----------
    path : str or Path
        Where to write.
    source : Path, optional
        What the result is made from, which it must not replace.

    Raises
    ------
    OutputError
        The ending is unknown; the folder does not exist or cannot be written; the file, or the JSON beside it, is
        the source or no result of ours, or would be taken for one of the source's frames.
    """
    target = Path(path)
    endings = (*IMAGE_ENDINGS, MODEL_ENDING, REPRESENTATION_ENDING, PICTURE_ENDING)
    if not target.name.lower().endswith(endings):
        raise OutputError(f"a result is written to a file ending in {', '.join(endings)}; got {target}")
    is_image = target.name.lower().endswith(IMAGE_ENDINGS)
    files = [target, sidecar_of(target)] if is_image else [target]
    for file in files:
        check_place(file)
        if source is not None and file.exists() and source.exists() and file.samefile(source):
            raise OutputError(f"{file} is what the result is made from, and would be lost; choose another name")
    if source is not None and _is_among(target, source):
        raise OutputError(f"{target} would be read as a frame of {source} from then on; choose another folder")
    if len(files) == 2 and files[1].exists() and not _is_ours(files[1]):
        raise OutputError(
            f"{files[1]} is not of napari-fiberburst, and would be lost; choose another name for {target}"
        )
    return target


def is_model(path: Path) -> bool:
    """Whether a path names a model: all that a result has."""
    return path.name.lower().endswith(MODEL_ENDING)


def is_representation(path: Path) -> bool:
    """Whether a path names what an image is drawn from, and no more, as version 0.1.0 wrote it."""
    return path.name.lower().endswith(REPRESENTATION_ENDING)


def is_picture(path: Path) -> bool:
    """Whether a path names a picture to look at, without the provenance that an image has."""
    return path.name.lower().endswith(PICTURE_ENDING)


def sidecar_of(path: Path) -> Path:
    """Return the JSON file beside an image: image.ome.tif has image.json."""
    name = path.name
    ending = next(ending for ending in IMAGE_ENDINGS if name.lower().endswith(ending))
    return path.with_name(name[: -len(ending)] + ".json")


def write_image(
    path: str | Path, image: NDArray[np.float32], acquisition: Acquisition, provenance: Mapping[str, Any]
) -> Path:
    """Write an image as OME-TIFF with pixel size and channel names, and its provenance as JSON beside it."""
    target = check_output(path)
    metadata: dict[str, Any] = {"axes": "YX" if image.ndim == 2 else "YXC"}
    unit = acquisition.unit or "µm"
    if acquisition.pixel_size is not None and unit in _OME_UNITS:
        height, width = acquisition.pixel_size
        metadata |= {"PhysicalSizeY": height, "PhysicalSizeYUnit": unit}
        metadata |= {"PhysicalSizeX": width, "PhysicalSizeXUnit": unit}
    if image.ndim == 3:
        image, metadata["axes"] = np.moveaxis(image, 2, 0), "CYX"
        if acquisition.channel_names:
            metadata["Channel"] = {"Name": list(acquisition.channel_names)}
    document = json.dumps(provenance, indent=1, allow_nan=False, default=plain_scalar)
    with write_whole(target) as stream, write_whole(sidecar_of(target)) as sidecar:
        tifffile.imwrite(stream, image, ome=True, photometric="minisblack", metadata=metadata)
        sidecar.write(document.encode())
    return target


def write_representation(path: str | Path, arrays: Mapping[str, NDArray[Any]], provenance: Mapping[str, Any]) -> Path:
    """Write named arrays and their provenance into one npz file."""
    target = check_output(path)
    document = json.dumps(provenance, allow_nan=False, default=plain_scalar)
    with write_whole(target) as stream:
        np.savez(stream, allow_pickle=False, provenance=np.array(document), **arrays)
    return target


def write_homographies(path: str | Path, homographies: NDArray[np.float64]) -> Path:
    """Write homographies as a table or as JSON.

    Parameters
    ----------
    path : str or Path
        ``.csv``: a line per frame, its number and the matrix row by row; ``.json``: the number of each frame with its
        3x3 matrix. Frames without a homography have nan in CSV and null in JSON.
    homographies : numpy.ndarray
        (T, 3, 3), frame-t pixel (x, y) to frame-0 pixel.

    Raises
    ------
    OutputError
        The folder does not exist or cannot be written, or the ending is neither of these.
    """
    target = Path(path)
    ending = target.suffix.lower()
    if ending == ".csv":
        head = "frame," + ",".join(f"h{row}{column}" for row in range(3) for column in range(3))
        lines = [
            f"{frame}," + ",".join(map(repr, matrix.ravel().tolist())) for frame, matrix in enumerate(homographies)
        ]
        text = "\n".join([head, *lines]) + "\n"
    elif ending == ".json":
        frames = [
            {"frame": frame, "homography": matrix.tolist() if np.isfinite(matrix).all() else None}
            for frame, matrix in enumerate(homographies)
        ]
        document = {**versions(), "maps": "frame-t pixel (x, y) to frame-0 pixel (x, y)", "frames": frames}
        text = json.dumps(document, indent=1, allow_nan=False)
    else:
        raise OutputError(f"homographies are written to a file ending in .csv or .json; got {target}")
    with write_whole(target) as stream:
        stream.write(text.encode())
    return target


def read_representation(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read what `write_representation` wrote.

    Raises
    ------
    OutputError
        The file is not there, damaged, or something else, or claims more than it can hold.
    """
    try:
        with open_arrays(path, OutputError) as stored:
            arrays = {name: stored[name] for name in stored}
        return arrays, parse_json(str(arrays.pop("provenance")))
    except OutputError:
        raise
    except Exception as error:  # a damaged archive fails in zipfile, zlib, numpy or json
        raise OutputError(
            f"{path} is no saved reconstruction, or is damaged; expected a .fiberburst or .npz file written by "
            "Reconstruction.save (a bundle is opened by Bundle.load)"
        ) from error


@contextmanager
def write_whole(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file that takes its name only when all is written; a killed run leaves the name as it was.

    Raises
    ------
    OutputError
        The folder does not exist or cannot be written.
    """
    check_place(path)
    partial = path.with_name(f".{token_hex(8)}{_PARTIAL}")
    try:
        with partial.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written ({error}); choose another place") from error
    finally:
        partial.unlink(missing_ok=True)


def is_partial(path: Path) -> bool:
    """Whether a path names a file that was being written when its run was killed."""
    return path.name.startswith(".") and path.name.endswith(_PARTIAL)


def check_place(path: Path) -> None:
    """Refuse a path that no file can be written to.

    Raises
    ------
    OutputError
        Its folder does not exist or cannot be written, or the path is a folder.
    """
    try:
        if not path.parent.is_dir():
            raise OutputError(f"the folder {path.parent} does not exist; make it first, or choose another")
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise OutputError(f"the folder {path.parent} cannot be written; choose another")
        if path.is_dir():
            raise OutputError(f"{path} is a folder; name a file in it")
    except OSError as error:
        raise OutputError(f"{path} cannot be written ({error}); choose another place") from error


def check_free(path: Path) -> None:
    """Refuse a path that is taken, because nothing is overwritten unasked.

    Raises
    ------
    OutputError
        There is something.
    """
    if path.exists():
        raise OutputError(f"{path} is there already; choose another name, remove it, or replace it by --overwrite")


def _is_among(target: Path, source: Path) -> bool:
    """Whether a file would lie in the folder, or match the pattern, that a burst is read from."""
    if source.is_dir():
        return target.parent.samefile(source)
    parent = source.parent
    return parent.is_dir() and target.parent.samefile(parent) and has_magic(source.name) and target.match(source.name)


def _is_ours(path: Path) -> bool:
    try:
        told = read_json(path)
    except OutputError:
        return False
    return isinstance(told, dict) and told.get("software") == SOFTWARE


def versions() -> dict[str, Any]:
    """Return what the result was made with: this software, Python, and the packages that decide its figures."""
    found = {"python": platform.python_version()}
    for name in _NAMED_PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return {"software": SOFTWARE, "versions": found}
