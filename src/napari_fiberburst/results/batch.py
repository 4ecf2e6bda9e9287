"""What has come of every recording of a folder: a row each."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.plain import read_json
from napari_fiberburst.io.results import write_whole


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What has come of one recording.

    Attributes
    ----------
    name : str
        Of the recording's file.
    verdict : str
        "good", "doubtful", "bad", "not judged", or "failed".
    notes : tuple of str
        What a user should know; of one that failed, why.
    facts : tuple of str
        What else there is to say, such as how many frames were used.
    seconds : float
        That it took.
    outputs : tuple of str
        What was written, relative to the folder of the batch.
    thumbnail : str
        A small PNG picture, relative to that folder; empty where there is none.
    """

    name: str
    verdict: str
    notes: tuple[str, ...] = ()
    facts: tuple[str, ...] = ()
    seconds: float = 0.0
    outputs: tuple[str, ...] = ()
    thumbnail: str = ""

    def save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write the row, and by what it is told whether it still holds."""
        with write_whole(path) as stream:
            stream.write(json.dumps({"identity": identity, "row": asdict(self)}, indent=1).encode())

    @classmethod
    def load(cls, path: Path, identity: dict[str, Any]) -> "Row | None":
        """Read a row; None where there is none, or where it is of something else or damaged."""
        if not path.exists():
            return None
        try:
            kept = read_json(path)
            if kept["identity"] != identity:
                return None
            row = kept["row"].items()
            told: Any = {name: tuple(value) if isinstance(value, list) else value for name, value in row}
            return cls(**told)
        except (OutputError, AttributeError, KeyError, TypeError):
            return None


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV: recording, verdict, seconds, facts, notes, outputs."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["recording", "verdict", "seconds", "facts", "notes", "outputs"])
    for row in rows:
        several = ("; ".join(part) for part in (row.facts, row.notes, row.outputs))
        writer.writerow([row.name, row.verdict, f"{row.seconds:.1f}", *several])
    with write_whole(path) as stream:
        stream.write(text.getvalue().encode())
