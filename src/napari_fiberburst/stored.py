"""Values of the method in files: arrays and JSON in the safetensors format, from which nothing can be executed.

A file is read once, into one buffer, and the arrays are views of it: none is copied. They are not mapped from the disk,
because a value must not change when its file does, and because the digest has to read every byte anyway.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ClassVar, Self, get_args, get_origin, get_type_hints

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from napari_fiberburst.errors import FiberBurstError, OutputError
from napari_fiberburst.io.plain import parse_json, plain_scalar
from napari_fiberburst.io.results import check_place, write_whole

Arrays = dict[str, NDArray[Any]]
_VERSION = 1
# The names that the format has for the types of numbers that are stored.
_DTYPES = {"F64": "<f8", "F32": "<f4", "I64": "<i8", "I32": "<i4", "U8": "|u1", "BOOL": "|b1"}
# A file begins with the length of its header, in so many bytes, which the format bounds.
_LENGTH, _LONGEST_HEADER = 8, 100_000_000


class Stored:
    """A frozen dataclass that can be kept in a file.

    Its fields are numpy arrays, tensors, plain values that JSON can hold, arrays by name (`Arrays`), dataclasses of
    these, or None.
    """

    __slots__ = ()
    # What the file calls itself, its ending, and what is raised where it cannot be read.
    _kind: ClassVar[str]
    _ending: ClassVar[str] = ".safetensors"
    _error: ClassVar[type[FiberBurstError]] = OutputError

    def save(self, path: str | Path) -> Path:
        """Write the value to a file, whole or not at all.

        Raises
        ------
        OutputError
            The folder does not exist or cannot be written, or the name has another ending.
        """
        target = self.check_output(path)
        arrays: Arrays = {}
        document = _document(self, arrays)
        metadata = {
            "format": f"napari-fiberburst {self._kind}",
            "version": str(_VERSION),
            "values": document,
            "digest": _digest(arrays, document),
        }
        with write_whole(target) as stream:
            stream.write(safetensors.numpy.save(arrays, metadata))
        return target

    def digest(self) -> str:
        """Return what tells this value from others of its kind: another one where anything in it differs."""
        arrays: Arrays = {}
        return _digest(arrays, _document(self, arrays))

    @classmethod
    def check_output(cls, path: str | Path) -> Path:
        """Refuse a path that no such value can be saved to; before long work rather than after it.

        Raises
        ------
        OutputError
            The folder does not exist or cannot be written, or the name has another ending.
        """
        target = Path(path)
        if not target.name.lower().endswith(cls._ending):
            raise OutputError(f"a {cls._kind} is written to a file ending in {cls._ending}; got {path}")
        check_place(target)
        return target

    @classmethod
    def load(cls, path: str | Path, *, device: str = "cpu") -> Self:
        """Read a value that was saved.

        Parameters
        ----------
        path : str or Path
            The file.
        device : str
            Where its tensors go.

        Raises
        ------
        FiberBurstError
            The file is not there, is damaged or was altered, or is of another kind or version.
        """
        arrays, document = cls._read(path)
        try:
            value: Self = _built(cls, parse_json(document), "", arrays, device)
            value._check()
        except (AttributeError, KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise cls._error(
                f"{path} holds no complete {cls._kind} ({error}); expected a file that napari-fiberburst has written; "
                "make it again"
            ) from error
        return value

    def _check(self) -> None:
        """Refuse contents that do not belong together, by a ValueError."""

    @classmethod
    def _read(cls, path: str | Path) -> tuple[Arrays, str]:
        """Return the arrays and the plain values of a file that is whole and as it was written."""
        try:
            if not Path(path).is_file():
                raise cls._error(f"there is no file {path}; expected a {cls._kind} that napari-fiberburst has written")
            stored = _Safetensors(Path(path))
            metadata = stored.metadata
            cls._check_format(path, metadata)
            arrays = stored.arrays()
        except FiberBurstError:
            raise
        except (OSError, ValueError, TypeError, LookupError, AttributeError, OverflowError, MemoryError) as error:
            raise cls._error(
                f"{path} is no {cls._kind}, or is damaged ({error}); expected a file that napari-fiberburst has "
                "written; make it again, or take another file"
            ) from error
        document = metadata.get("values", "")
        if metadata.get("digest") != _digest(arrays, document):
            raise cls._error(
                f"{path} was altered after it was written: its digest does not match its contents; make it again, or "
                "take another file"
            )
        return arrays, document

    @classmethod
    def _check_format(cls, path: str | Path, metadata: Mapping[str, str]) -> None:
        expected = f"napari-fiberburst {cls._kind}"
        if metadata.get("format") != expected:
            raise cls._error(
                f"{path} is of format {metadata.get('format', 'unknown')!r}; expected {expected!r}; take another file"
            )
        if metadata.get("version") != str(_VERSION):
            raise cls._error(
                f"{path} is of version {metadata.get('version')}; expected version {_VERSION}; update "
                f"napari-fiberburst, or make the {cls._kind} again"
            )


class _Safetensors:
    """A file in the safetensors format: its header at first, and its arrays once they are asked for.

    The format's own library copies each array, and does not say where in the file it lies.

    Raises
    ------
    OSError, ValueError, TypeError, LookupError, AttributeError, OverflowError, MemoryError
        The file is of another format, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as stream:
            size = path.stat().st_size
            length = int.from_bytes(stream.read(_LENGTH), "little")
            if not 2 <= length <= min(size - _LENGTH, _LONGEST_HEADER):
                raise ValueError(f"it has {size} bytes, and its header is said to have {length}")
            header = parse_json(stream.read(length))
        self.metadata: dict[str, str] = header.pop("__metadata__", {})
        if not all(isinstance(value, str) for value in self.metadata.values()):
            raise ValueError("its metadata must be text")
        self._tensors, self._first, self._size = header, _LENGTH + length, size

    def arrays(self) -> Arrays:
        """Return the arrays, which are views of one buffer."""
        end = max((told["data_offsets"][1] for told in self._tensors.values()), default=0)
        if self._first + end != self._size:
            raise ValueError(f"its header tells of {self._first + end} bytes, and it has {self._size}")
        buffer = bytearray(self._size)
        with self._path.open("rb") as stream:
            if stream.readinto(buffer) != self._size:
                raise ValueError("it was cut short while it was read")
        found: Arrays = {}
        for name, told in self._tensors.items():
            dtype, shape = np.dtype(_DTYPES[told["dtype"]]), tuple(told["shape"])
            start, stop = told["data_offsets"]
            count = math.prod(shape)
            if min(shape, default=0) < 0 or not 0 <= start <= stop or stop - start != count * dtype.itemsize:
                raise ValueError(f"{name} of shape {shape} cannot lie in bytes {start} to {stop}")
            found[name] = (
                np.frombuffer(buffer, dtype, count, self._first + start).reshape(shape)
                if count
                else (np.empty(shape, dtype))
            )
        return found


def _document(value: Any, arrays: Arrays) -> str:
    """Return all of a dataclass that is no array, as JSON; its arrays go into `arrays`."""
    return json.dumps(_flattened(value, "", arrays), allow_nan=True, sort_keys=True, default=plain_scalar)


def _flattened(value: Any, prefix: str, arrays: Arrays) -> dict[str, Any]:
    """Return the plain fields of a dataclass, nested; its arrays go into `arrays` under dotted names."""
    plain: dict[str, Any] = {}
    for item in fields(value):
        part, name = getattr(value, item.name), prefix + item.name
        if hasattr(part, "detach"):
            arrays[name] = np.asarray(part.detach().cpu().numpy(), order="C")
        elif isinstance(part, np.ndarray):
            arrays[name] = np.asarray(part, order="C")
        elif isinstance(part, Mapping) and any(isinstance(one, np.ndarray) for one in part.values()):
            arrays |= {f"{name}.{own}": np.asarray(one, order="C") for own, one in part.items()}
        elif is_dataclass(part):
            plain[item.name] = _flattened(part, name + ".", arrays)
        else:
            plain[item.name] = dict(part) if isinstance(part, Mapping) else part
    return plain


def _built(kind: type[Any], plain: Mapping[str, Any], prefix: str, arrays: Arrays, device: str) -> Any:
    """Return the dataclass that `_flattened` has taken apart."""
    hints = get_type_hints(kind)
    found = {}
    for item in fields(kind):
        name, hint = prefix + item.name, _without_none(hints[item.name])
        if name in arrays:
            found[item.name] = _placed(arrays[name], device) if hint.__name__ == "Tensor" else arrays[name]
        elif hint == Arrays:
            found[item.name] = {
                own.removeprefix(name + "."): one for own, one in arrays.items() if own.startswith(name + ".")
            }
        elif plain[item.name] is not None and is_dataclass(hint):
            found[item.name] = _built(hint, plain[item.name], name + ".", arrays, device)  # type: ignore[arg-type]
        elif get_origin(hint) is tuple and plain[item.name] is not None:
            found[item.name] = tuple(plain[item.name])
        else:
            found[item.name] = plain[item.name]
    return kind(**found)


def _without_none(hint: Any) -> Any:
    if isinstance(hint, UnionType):
        (hint,) = [option for option in get_args(hint) if option is not NoneType]
    return hint


def _placed(array: NDArray[Any], device: str) -> Any:
    import torch  # only values of the method hold tensors: opening a bundle or a burst does without

    return torch.from_numpy(array).to(device)


def _digest(arrays: Arrays, document: str) -> str:
    """Return a digest of all that is stored, in whatever order it is."""
    digest = hashlib.sha256(document.encode())
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape}".encode())
        digest.update(np.ascontiguousarray(arrays[name]).data)
    return digest.hexdigest()
