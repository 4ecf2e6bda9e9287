"""What work on a recording writes: where it goes, and the table of the places of its frames."""

import csv
import io
import re
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.results import check_free, check_place, write_whole
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.work import check_unused, is_begun

ENDING = ".ome.zarr"
_POSES, _TRACES, _TABLE = _BESIDE = (".poses.csv", ".traces.zarr", ".traces.csv")
# Units of length as OME-NGFF names them.
OME_UNITS = {"µm": "micrometer", "nm": "nanometer", "mm": "millimeter"}


def check_target(output: str | Path, what: str) -> Path:
    """Refuse a path that a mosaic or a video cannot be written to, before long work rather than after it.

    Raises
    ------
    OutputError
        It has another ending, is there already, or its folder cannot be written; or the folder of its work holds
        something of others.
    """
    target = Path(output).resolve()  # workers may have another current folder
    if not target.name.endswith(ENDING):
        raise OutputError(f"a {what} is written to a folder ending in {ENDING}; got {output}")
    poses = poses_of(target)
    for path in (target, poses):
        if not is_begun(work_of(target)):
            check_free(path)
    check_place(poses)
    check_unused(work_of(target))  # it is removed once the work is done
    return target


def work_of(output: Path) -> Path:
    """Return the folder of the work on an output."""
    return output.with_name(output.name.removesuffix(ENDING) + ".work")


def outputs_of(output: Path) -> list[Path]:
    """Return what a finished mosaic or video has written: the table of places, by which pieces are known, and these."""
    poses = poses_of(output)
    if not poses.exists():
        return [output]
    with poses.open(newline="", encoding="utf-8") as table:
        pieces = {int(row["piece"]) for row in csv.DictReader(table) if row["piece"]}
    return [piece_of(output, piece) for piece in sorted({0, *pieces})] + [poses, *traces_of(output)]


def poses_of(output: Path) -> Path:
    """Return the table of places beside an output."""
    return output.with_name(output.name.removesuffix(ENDING) + _POSES)


def traces_of(output: Path) -> tuple[Path, Path]:
    """Return the traces beside a video, of cores and of regions."""
    zarr, table = (output.with_name(output.name.removesuffix(ENDING) + end) for end in (_TRACES, _TABLE))
    return zarr, table


def is_beside(output: Path, path: Path) -> bool:
    """Whether a path is one that a mosaic or a video writes: the output, its pieces, or their tables and traces."""
    stem = re.escape(output.name.removesuffix(ENDING))
    endings = "|".join(map(re.escape, (ENDING, *_BESIDE)))
    return path.parent == output.parent and re.fullmatch(rf"{stem}(-\d+)?({endings})", path.name) is not None


def piece_of(output: Path, piece: int) -> Path:
    """Return the picture of a piece, the largest first."""
    stem = output.name.removesuffix(ENDING)
    return output if piece == 0 else output.with_name(f"{stem}-{piece + 1}{ENDING}")


def identity(source: FrameSource, *, bundle: Bundle | None, **settings: Any) -> dict[str, Any]:
    """Return what work on a recording is told by, as plain values."""
    return {
        "recording": source.fingerprint,
        "bundle": None if bundle is None else bundle.digest(),
        "version": version("napari-fiberburst"),
        **settings,
    }


def write_poses(path: Path, track: Track, source: FrameSource, pictures: Mapping[int, Grid]) -> None:
    """Write where frames lie as CSV: frame, seconds, piece, used, and h00 to h22.

    The matrix leads from frame pixels to pixels of the picture of the frame's piece, (x, y), integers at pixel centres.
    Frames of pieces that have no picture are not used.
    """
    times = source.acquisition.times
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", "seconds", "piece", "used", *(f"h{i}{j}" for i in range(3) for j in range(3))])
    for number, (matrix, piece) in enumerate(zip(track.planes(), track.piece, strict=True)):
        seconds = "" if times is None else repr(float(times[number]))
        if piece not in pictures:
            writer.writerow([number, seconds, "", 0, *[""] * 9])
            continue
        grid = pictures[int(piece)]
        placed = np.array([[1, 0, -grid.x0], [0, 1, -grid.y0], [0, 0, 1]]) @ matrix
        writer.writerow([number, seconds, int(piece), 1, *(repr(float(value)) for value in placed.ravel())])
    with write_whole(path) as stream:
        stream.write(text.getvalue().encode())
