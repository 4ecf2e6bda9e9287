"""Every recording of a folder, one after the other, with the same settings."""

import time
import tomllib
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.errors import BurstError, ClusterError, FullDiskError, SettingsError
from napari_fiberburst.io import open_recording
from napari_fiberburst.io.archive import ARCHIVE_ENDINGS
from napari_fiberburst.io.folder import IMAGE_ENDINGS, natural_key
from napari_fiberburst.io.picture import as_picture, encode_png
from napari_fiberburst.io.results import write_whole
from napari_fiberburst.io.tiff import TIFF_ENDINGS
from napari_fiberburst.io.video_container import VIDEO_ENDINGS
from napari_fiberburst.io.zarr import is_zarr
from napari_fiberburst.pipeline.reconstruct import as_bundle
from napari_fiberburst.recordings.outputs import identity
from napari_fiberburst.recordings.tasks import TASKS, Made, Settings
from napari_fiberburst.recordings.work import Doing, claim, forget, is_begun, remove, room
from napari_fiberburst.results.batch import Row

_ENDINGS = (*TIFF_ENDINGS, *VIDEO_ENDINGS, *ARCHIVE_ENDINGS)
# Longer side of a thumbnail, pixels.
_THUMBNAIL = 192
# What one recording alone can fail by; others go on.
_FAILURES = (ValueError, OSError, RuntimeError, LookupError, ArithmeticError, MemoryError)

# Settings that name a file or a folder.
_PATHS = ("bundle", "regions")
_OPENING = ("axes", "black_level", "white_level")


def read_settings(path: Path | None, task: str, given: Settings | None = None) -> dict[str, dict[str, Any]]:
    """Read a settings file.

    Parameters
    ----------
    path : Path or None
        A TOML file with a table for each task, such as ``[mosaic]``, and ``[recording]`` for how recordings are opened.
        ``bundle`` and ``regions`` are paths, relative to the file.
    task : str
        Whose table is checked.
    given : mapping, optional
        Settings of the task that go before those of the file.

    Returns
    -------
    dict
        The tables "recording" and of the task, empty where the file has none.

    Raises
    ------
    SettingsError
        The file cannot be read, or a name or value in it is unknown.
    """
    try:
        tables = {} if path is None else _tables(path)
    except (OSError, ValueError, RecursionError) as error:
        raise SettingsError(f"{path} cannot be read as TOML ({error}); mend it, or take another file") from error
    known = ("recording", *TASKS)
    for name, table in tables.items():
        if name not in known or not isinstance(table, dict):
            tables_known = ", ".join(f"[{name}]" for name in known)
            raise SettingsError(f"{name} in {path} is no table that is known; expected {tables_known}")
    opening, own = dict(tables.get("recording", {})), dict(tables.get(task, {}))
    for name in opening:
        if name not in _OPENING:
            raise SettingsError(f"{name} is not of how recordings are opened; expected {', '.join(_OPENING)}")
    for name in _PATHS:
        if path is not None and isinstance(own.get(name), str):
            own[name] = str((path.parent / own[name]).resolve())
    own |= given or {}
    TASKS[task][1]({name: value for name, value in own.items() if name != "bundle"})
    return {"recording": opening, task: own}


def _tables(path: Path) -> dict[str, Any]:
    if path.exists() and not path.is_file():
        raise ValueError("it is no file")
    return tomllib.loads(path.read_text(encoding="utf-8"))


def recordings_in(folder: Path, but: Path | None = None) -> list[Path]:
    """Return the recordings of a folder, in natural order: videos, TIFF stacks, archives, OME-Zarr, folders of frames.

    Raises
    ------
    BurstError
        There is no such folder, or it has none.
    """
    if not folder.is_dir():
        raise BurstError(f"there is no folder {folder}; expected one with recordings in it")
    found = [path for path in folder.iterdir() if path != but and not path.name.startswith(".") and _is_recording(path)]
    if not found:
        raise BurstError(f"{folder} has no recordings; expected videos, TIFF stacks, OME-Zarr or folders of frames")
    return sorted(found, key=natural_key)


def _is_recording(path: Path) -> bool:
    if path.is_dir():
        return is_zarr(path) or any(file.suffix.lower() in IMAGE_ENDINGS for file in path.iterdir())
    return path.name.lower().endswith(_ENDINGS)


def batching(
    folder: Path,
    output: Path,
    task: str,
    *,
    settings: Mapping[str, Settings],
    client: Any | None,
    on_rows: Callable[[Sequence[Row]], object],
) -> Generator[Doing, None, tuple[Row, ...]]:
    """Do a task with every recording of a folder; yields what is being done.

    A recording that fails has a row that says why, and is tried again when the batch is.

    Parameters
    ----------
    folder : Path
        Of the recordings.
    output : Path
        A folder; each recording has one in it that is called as its file. Done there already is not done again.
    task : str
        One of `TASKS`.
    settings : mapping
        As `read_settings` gives them.
    client : distributed.Client, optional
        Where units of work are done.
    on_rows : callable
        Is given all rows so far, whenever there is one more.

    Raises
    ------
    BurstError
        There are no recordings.
    OutputError
        Another batch was begun in the output, or the disk is full.
    """
    paths = recordings_in(folder, output)
    claim(output, {"task": task, "settings": {name: dict(table) for name, table in settings.items()}})
    own = dict(settings[task])
    bundle = as_bundle(own.pop("bundle")) if "bundle" in own else None
    rows: list[Row] = []
    for number, path in enumerate(paths):
        steps = _one(path, output / path.name, task, settings["recording"], own, bundle, client)
        while True:
            try:
                doing = next(steps)
            except StopIteration as end:
                rows.append(end.value)
                break
            yield replace(doing, what=f"{path.name}: {doing.what}", step=number, steps=len(paths))
        on_rows(rows)
    return tuple(rows)


def _one(
    path: Path, place: Path, task: str, opening: Settings, own: Settings, bundle: Bundle | None, client: Any | None
) -> Generator[Doing, None, Row]:
    begun = time.monotonic()
    yield Doing("opening", left=1)
    try:
        source = open_recording(path, **opening)
        told = identity(source, bundle=bundle, task=task, **own)
        kept = Row.load(place / "row.json", told)
        if kept is not None:
            return kept
        with room(place.parent):
            if _lacks_only_its_row(place):
                remove(place)
            place.mkdir(exist_ok=True)
            made = yield from TASKS[task][0](source, place, bundle, own, client)
            row = _row(path.name, made, place, time.monotonic() - begun)
            row.save(place / "row.json", told)
    except (ClusterError, FullDiskError):
        raise
    except _FAILURES as error:
        why = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        return Row(name=path.name, verdict="failed", notes=(why,), seconds=time.monotonic() - begun)
    return row


def _lacks_only_its_row(place: Path) -> bool:
    """Whether the work in a folder of the batch was done, and was killed before it had a row."""
    return place.exists() and not (place / "row.json").exists() and not any(map(is_begun, place.glob("*.work")))


def discard_batch(folder: Path, output: Path) -> None:
    """Remove what a batch has made of the recordings of a folder; what else lies in its output stays.

    Raises
    ------
    BurstError
        There are no recordings.
    """
    if is_begun(output):
        for path in recordings_in(folder, output):
            remove(output / path.name)
        for name in ("report.html", "table.csv"):
            remove(output / name)
        forget(output)


def _row(name: str, made: Made, place: Path, seconds: float) -> Row:
    small = Image.fromarray(as_picture(made.picture))
    small.thumbnail((_THUMBNAIL, _THUMBNAIL))
    with write_whole(place / "thumbnail.png") as stream:
        stream.write(encode_png(np.asarray(small)))
    return Row(
        name=name,
        verdict=made.verdict,
        notes=made.notes,
        facts=made.facts,
        seconds=seconds,
        outputs=tuple(path.resolve().relative_to(place.parent).as_posix() for path in made.outputs),
        thumbnail=f"{place.name}/thumbnail.png",
    )
