"""Values of the method in files: arrays and JSON in the safetensors format, from which nothing can be executed."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ClassVar, Self, get_args, get_origin, get_type_hints

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from napari_fiberburst.errors import FiberBurstError, OutputError
from napari_fiberburst.io.results import write_whole

Arrays = dict[str, NDArray[Any]]
_VERSION = 1


class Stored:
    """A frozen dataclass that can be kept in a file.

    Its fields are numpy arrays, tensors, plain values that JSON can hold, dataclasses of these, or None.
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
        target = Path(path)
        if not target.name.lower().endswith(self._ending):
            raise OutputError(f"a {self._kind} is written to a file ending in {self._ending}; got {path}")
        arrays: Arrays = {}
        document = json.dumps(_flattened(self, "", arrays), allow_nan=True, sort_keys=True)
        metadata = {
            "format": f"napari-fiberburst {self._kind}",
            "version": str(_VERSION),
            "values": document,
            "digest": _digest(arrays, document),
        }
        with write_whole(target) as stream:
            stream.write(safetensors.numpy.save(arrays, metadata))
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
            value: Self = _built(cls, json.loads(document), "", arrays, device)
            value._check()
        except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
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
        if not Path(path).is_file():
            raise cls._error(f"there is no file {path}; expected a {cls._kind} that napari-fiberburst has written")
        try:
            with safe_open(str(path), framework="numpy") as stored:
                metadata = stored.metadata() or {}
                arrays: Arrays = {name: stored.get_tensor(name) for name in stored.keys()}
        except (SafetensorError, OSError) as error:
            raise cls._error(
                f"{path} is no {cls._kind}, or is damaged ({error}); expected a file that napari-fiberburst has "
                "written; make it again, or take another file"
            ) from error
        expected = f"napari-fiberburst {cls._kind}"
        if metadata.get("format") != expected:
            raise cls._error(f"{path} is of format {metadata.get('format', 'unknown')!r}; expected {expected!r}")
        if metadata.get("version") != str(_VERSION):
            raise cls._error(
                f"{path} is of version {metadata.get('version')}; expected version {_VERSION}; update "
                f"napari-fiberburst, or make the {cls._kind} again"
            )
        document = metadata.get("values", "")
        if metadata.get("digest") != _digest(arrays, document):
            raise cls._error(
                f"{path} was altered after it was written: its digest does not match its contents; make it again, or "
                "take another file"
            )
        return arrays, document


def _flattened(value: Any, prefix: str, arrays: Arrays) -> dict[str, Any]:
    """Return the plain fields of a dataclass, nested; its arrays go into `arrays` under dotted names."""
    plain: dict[str, Any] = {}
    for item in fields(value):
        part, name = getattr(value, item.name), prefix + item.name
        if hasattr(part, "detach"):
            arrays[name] = np.ascontiguousarray(part.detach().cpu().numpy())
        elif isinstance(part, np.ndarray):
            arrays[name] = np.ascontiguousarray(part)
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
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()
