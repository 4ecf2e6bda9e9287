"""Results out: a picture with its provenance beside it, or the fitted networks.

Every file is written whole or not at all.
"""

import json
import os
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from napari_fiberburst.burst import Acquisition
from napari_fiberburst.errors import OutputError

PICTURE_ENDINGS = (".ome.tif", ".ome.tiff", ".tif", ".tiff")
REPRESENTATION_ENDING = ".npz"
_NAMED_PACKAGES = ("napari-fiberburst", "numpy", "scipy", "torch", "scikit-image", "tifffile")


def check_output(path: str | Path) -> Path:
    """Refuse a path that a result could not be written to; before a long run rather than after it.

    Raises
    ------
    OutputError
        Its ending is unknown, or its folder does not exist or cannot be written.
    """
    target = Path(path)
    endings = (*PICTURE_ENDINGS, REPRESENTATION_ENDING)
    if not target.name.lower().endswith(endings):
        raise OutputError(f"a result is written to a file ending in {', '.join(endings)}; got {target}")
    _check_folder(target)
    return target


def sidecar_of(path: Path) -> Path:
    """Return the JSON file beside a picture: picture.ome.tif has picture.json."""
    name = path.name
    ending = next(ending for ending in PICTURE_ENDINGS if name.lower().endswith(ending))
    return path.with_name(name[: -len(ending)] + ".json")


def write_picture(
    path: str | Path, image: NDArray[np.float32], acquisition: Acquisition, provenance: Mapping[str, Any]
) -> Path:
    """Write an image as OME-TIFF with pixel size and channel names, and its provenance as JSON beside it."""
    target = check_output(path)
    metadata: dict[str, Any] = {"axes": "YX" if image.ndim == 2 else "YXC"}
    if acquisition.pixel_size is not None:
        height, width = acquisition.pixel_size
        unit = acquisition.unit or "µm"
        metadata |= {"PhysicalSizeY": height, "PhysicalSizeYUnit": unit}
        metadata |= {"PhysicalSizeX": width, "PhysicalSizeXUnit": unit}
    if image.ndim == 3:
        image, metadata["axes"] = np.moveaxis(image, 2, 0), "CYX"
        if acquisition.channel_names:
            metadata["Channel"] = {"Name": list(acquisition.channel_names)}
    document = json.dumps({**_versions(), **provenance}, indent=1, allow_nan=False, default=_plain)
    with write_whole(target) as stream:
        tifffile.imwrite(stream, image, ome=True, photometric="minisblack", metadata=metadata)
    with write_whole(sidecar_of(target)) as stream:
        stream.write(document.encode())
    return target


def write_representation(path: str | Path, arrays: Mapping[str, NDArray[Any]], provenance: Mapping[str, Any]) -> Path:
    """Write named arrays and their provenance into one npz file."""
    target = check_output(path)
    document = json.dumps({**_versions(), **provenance}, allow_nan=False, default=_plain)
    with write_whole(target) as stream:
        np.savez(stream, allow_pickle=False, provenance=np.array(document), **arrays)
    return target


def read_representation(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read what `write_representation` wrote.

    Raises
    ------
    OutputError
        The file is not there, damaged, or something else.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored}
        return arrays, json.loads(str(arrays.pop("provenance")))
    except Exception as error:  # a damaged archive fails in zipfile, zlib, numpy or json
        raise OutputError(
            f"{path} is no saved reconstruction ({type(error).__name__}: {error}); expected a .npz file written by "
            "Reconstruction.save"
        ) from error


@contextmanager
def write_whole(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file that takes its name only when all is written; a killed run leaves the name as it was.

    Raises
    ------
    OutputError
        The folder does not exist or cannot be written.
    """
    _check_folder(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
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


def _check_folder(path: Path) -> None:
    if not path.parent.is_dir():
        raise OutputError(f"the folder {path.parent} does not exist; make it first, or choose another")
    if path.is_dir():
        raise OutputError(f"{path} is a folder; name a file in it")
    if not os.access(path.parent, os.W_OK):
        raise OutputError(f"the folder {path.parent} cannot be written; choose another")


def _versions() -> dict[str, Any]:
    found = {"python": platform.python_version()}
    for name in _NAMED_PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return {"software": "napari-fiberburst", "versions": found}


def _plain(value: Any) -> Any:
    """Turn numpy's scalars into Python's for JSON."""
    convert: Callable[[], Any] | None = getattr(value, "item", None)
    if convert is None:
        raise TypeError(f"{type(value).__name__} has no place in JSON")
    return convert()
