"""JSON from files that anybody may have written."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.bounds import check_file

# What this package writes is nested some ten deep.
_DEEPEST = 100


def parse_json(text: str | bytes) -> Any:
    """Return plain values that are nested so little that anything can walk through them.

    Raises
    ------
    ValueError
        The text is no JSON, or is nested more than 100 deep.
    """
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested without end") from error
    level = [value]
    for _ in range(_DEEPEST):
        level = [
            part
            for one in level
            if isinstance(one, dict | list)
            for part in (one.values() if isinstance(one, dict) else one)
        ]
        if not level:
            return value
    raise ValueError(f"it is nested more than {_DEEPEST} deep")


def read_json(path: Path) -> Any:
    """Read plain values from a file.

    Raises
    ------
    OutputError
        It is no file, cannot be read, or holds no JSON that `parse_json` takes.
    """
    try:
        check_file(path, OutputError)
        return parse_json(path.read_bytes())
    except OutputError:
        raise
    except (OSError, ValueError) as error:
        raise OutputError(
            f"{path} holds no JSON that can be read ({error}); remove it, or take another file"
        ) from error


def plain_scalar(value: Any) -> Any:
    """Turn numpy's scalars into Python's, as `json.dumps` asks for what it does not know.

    Raises
    ------
    TypeError
        It is none.
    """
    convert: Callable[[], Any] | None = getattr(value, "item", None)
    if convert is None:
        raise TypeError(f"{type(value).__name__} has no place in JSON")
    return convert()
