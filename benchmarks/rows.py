"""Rows of a table as one file: JSON, one row a line.

A row is appended whole and is on the disk when the call returns. A process that is killed leaves at most a last line
without its end, which is no row.
"""

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from napari_fiberburst.errors import OutputError

Row = dict[str, Any]
Key = tuple[str, str]


def key(row: Row) -> Key:
    """Return what identifies a row in its table: its case and its method."""
    return row["case"], row["method"]


def read_rows(path: Path) -> dict[Key, Row]:
    """Return the rows of a file in its order; none where there is no file.

    Raises
    ------
    OutputError
        A line is no row.
    """
    if not path.exists():
        return {}
    rows: dict[Key, Row] = {}
    for number, line in enumerate(_whole_lines(path.read_bytes()).splitlines(), start=1):
        try:
            row: Row = json.loads(line)
            rows[key(row)] = row
        except (ValueError, TypeError, KeyError) as error:
            raise OutputError(
                f"line {number} of {path} is no row: expected a JSON object with case and method; take the line out, "
                "or measure anew with --overwrite"
            ) from error
    return rows


def put_row(path: Path, row: Row) -> None:
    """Append a row; where the file has one of the same case and method, the new row takes its place."""
    known = read_rows(path)
    if key(row) in known:
        write_rows(path, {**known, key(row): row}.values())
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as file:
        file.write(_line(row))
        file.flush()
        os.fsync(file.fileno())


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write all rows of a table, whole or not at all."""
    write_whole(path, b"".join(map(_line, rows)))


def drop_half_line(path: Path) -> bool:
    """Cut off a last line that was not written to its end; return whether there was one."""
    content = path.read_bytes()
    whole = _whole_lines(content)
    if len(whole) == len(content):
        return False
    os.truncate(path, len(whole))
    return True


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that takes its name only when all of it is on the disk; its folder is made where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def plain(row: Row) -> Row:
    """Return a row as it reads after it was written: tuples are lists, numpy's numbers Python's."""
    copied: Row = json.loads(_line(row))
    return copied


def _line(row: Row) -> bytes:
    return json.dumps(row, default=float).encode() + b"\n"


def _whole_lines(content: bytes) -> bytes:
    return content[: content.rfind(b"\n") + 1]
