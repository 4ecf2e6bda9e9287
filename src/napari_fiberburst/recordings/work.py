"""Work on a recording in units, each a plain function that writes its own file: here, on several processes, or again.

A unit that is done leaves a marker. Work that was cut short goes on with the units that have none, and comes to the
same bits as work that was not, because no unit depends on the order in which others are done.
"""

import ctypes
import errno
import json
import os
import pickle
import shutil
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import ClusterError, FiberBurstError, FullDiskError, OutputError
from napari_fiberburst.io.plain import read_json
from napari_fiberburst.io.results import check_free, is_partial, write_whole

# In the folder of work: what it is, and what it has begun to write outside.
_IDENTITY, _OUTPUTS = "work.json", "outputs.json"
# The command that has begun it, where one has.
_COMMAND = "command.json"
# A unit that fails by something else than what a user can mend, such as a file server that did not answer, is tried
# again so many times.
_RETRIES = 2
# What the client hands to workers is in a file of this name and its digest.
_HANDED = "handed-"
# As many digits of a key tell one from another.
_DIGITS = 12
_FULL = (errno.ENOSPC, errno.EDQUOT)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Work:
    """What every unit knows.

    Attributes
    ----------
    source : FrameSource
        The recording.
    bundle : Bundle
        At the place where it is in these frames.
    folder : Path
        Where units leave what they have made.
    """

    source: FrameSource
    bundle: Bundle
    folder: Path

    def shared(self, stage: str) -> Path:
        """Return the file that all units of a stage read."""
        return self.folder / stage / "all.safetensors"

    def path(self, stage: str, number: int) -> Path:
        """Return the file that a unit writes."""
        return self.folder / stage / f"{number:06d}.safetensors"

    def begin(self, stage: str) -> None:
        """Make the place for a stage."""
        (self.folder / stage).mkdir(parents=True, exist_ok=True)

    def marker(self, stage: str, number: int) -> Path:
        """Return the file whose presence says that a unit is done, for this recording, bundle and settings."""
        return self.folder / stage / f"{number:06d}-{_key(self)}.done"


@lru_cache(maxsize=4)
def _key(work: Work) -> str:
    known = work.folder / _IDENTITY
    identity = known.read_bytes() if known.exists() else b""
    return sha256(identity + f"{work.source.fingerprint}{work.bundle.digest()}".encode()).hexdigest()[:_DIGITS]


@dataclass(frozen=True, slots=True)
class Doing:
    """What is being done.

    Attributes
    ----------
    what : str
        In words.
    step, steps : int
        The number of the step, and how many there are of this kind.
    left, units : int
        How many of its units are left, of how many.
    grown : Path or None
        An image on disk that shows more than before, at every zoom; None where none does.
    """

    what: str
    step: int = 0
    steps: int = 1
    left: int = 0
    units: int = 1
    grown: Path | None = None

    @property
    def part(self) -> float:
        """How much of all steps of this kind is done, 0 to 1."""
        return (self.step + 1 - self.left / max(1, self.units)) / self.steps


# What does one unit of a stage: given the work, the name of the stage, and the unit's number.
Unit = Callable[[Work, str, int], None]


def complete(
    unit: Unit, stage: str, work: Work, numbers: Sequence[int], client: Any | None = None
) -> Iterator[tuple[int, int]]:
    """Do those units of a stage that are not done yet; yields the number of each, and how many are left.

    Parameters
    ----------
    unit : callable
        Does one.
    stage : str
        Where its files go.
    work : Work
        What it knows.
    numbers : sequence of int
        All units of the stage.
    client : distributed.Client, optional
        Where to do them; by default in this process, one after the other.
    """
    left = [number for number in numbers if not work.marker(stage, number).exists()]
    outcomes = _here(unit, stage, work, left) if client is None else _there(unit, stage, work, left, client)
    with closing(outcomes):
        for count, (number, error) in enumerate(outcomes, start=1):
            if error is not None:
                raise error
            yield number, len(left) - count


# The number of a unit, and what a user has to mend before it can be done.
Outcome = tuple[int, FiberBurstError | None]


def _here(unit: Unit, stage: str, work: Work, numbers: Sequence[int]) -> Generator[Outcome, None, None]:
    for number in numbers:
        yield _do(unit, stage, work, number)


def _there(unit: Unit, stage: str, work: Work, numbers: Sequence[int], client: Any) -> Generator[Outcome, None, None]:
    from distributed import CancelledError, KilledWorker, as_completed  # an extra

    # No key is used again: a result that the scheduler still knows would be taken for that of other work.
    futures = client.map(
        _do_on_worker,
        numbers,
        unit=unit,
        stage=stage,
        handed=_handed(work),
        key=stage,
        pure=False,
        retries=_RETRIES,
    )
    try:
        for future in as_completed(futures):  # type: ignore[no-untyped-call]
            yield future.result()
    except KilledWorker as error:
        raise ClusterError(
            f"workers were lost again and again over one unit of {stage}, most likely because their memory was too "
            "little; take fewer workers with more memory each, and give the same command again to go on"
        ) from error
    except CancelledError as error:
        raise ClusterError(
            f"the scheduler was lost during {stage}; start it again, and give the same command again to go on"
        ) from error
    finally:
        left = [future for future in futures if not future.done()]
        if left and client.status == "running":
            client.cancel(left)


def _do(unit: Unit, stage: str, work: Work, number: int) -> Outcome:
    """Do one unit that is not done yet, whoever asks: a worker's loss takes what it knew of units that it had done."""
    marker = work.marker(stage, number)
    try:
        if not marker.exists():
            with room(work.folder):
                unit(work, stage, number)
                marker.touch()
    except FiberBurstError as error:
        return number, type(error)(f"{error} ({stage}, unit {number})")
    finally:
        _give_back()
    return number, None


def _give_back() -> None:
    """Give memory that is not used any more back to the system, where the C runtime can be asked to.

    glibc keeps what was freed, and units of different stages need pieces of different sizes: over thousands of frames
    twice the memory that is in use would gather.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
        if trim is not None:
            trim(0)


def _do_on_worker(number: int, unit: Unit, stage: str, handed: str) -> Outcome:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # there are as many workers as cores
    try:
        return _do(unit, stage, _taken(handed), number)
    finally:
        torch.set_num_threads(threads)


@lru_cache(maxsize=2)
def _handed(work: Work) -> str:
    """Return a file that workers take the work from, each of them once.

    In a file, because what was scattered is gone when the worker that holds it is.
    """
    told = pickle.dumps(work)
    path = work.folder / f"{_HANDED}{sha256(told).hexdigest()}.pickle"
    with write_whole(path) as stream:
        stream.write(told)
    return str(path)


@lru_cache(maxsize=2)
def _taken(path: str) -> Work:
    """Return the work that was handed over: one object for all units, so that what they know by it is known once.

    Raises
    ------
    OutputError
        The file is not what the client has written: unpickling what somebody else has put there would run it.
    """
    file = Path(path)
    told = file.read_bytes()
    if sha256(told).hexdigest() != file.stem.removeprefix(_HANDED):
        raise OutputError(f"{file} was altered since this run wrote it; give the same command again with --fresh")
    work: Work = pickle.loads(told)
    return work


@contextmanager
def room(folder: Path) -> Iterator[None]:
    """Say what to do where the disk is full.

    Raises
    ------
    FullDiskError
        It is.
    """
    try:
        yield
    except FullDiskError:
        raise
    except (OSError, OutputError) as error:
        cause = error.__cause__ if isinstance(error, OutputError) else error
        if not isinstance(cause, OSError) or cause.errno not in _FULL:
            raise
        raise FullDiskError(
            f"the disk of {folder} is full; make room, and give the same command again: what is done stays"
        ) from error


def claim(folder: Path, identity: dict[str, Any]) -> bool:
    """Make a folder for work, or go on in one that was made for the same; whether some was done there.

    Parameters
    ----------
    folder : Path
        For this work alone.
    identity : dict
        The recording's fingerprint, the settings and the version, as plain values.

    Raises
    ------
    OutputError
        Other work has been begun there; the message names what differs.
    """
    if is_begun(folder):
        known = _told(folder / _IDENTITY, dict)
        names = sorted(set(known) | set(identity))
        other = [name for name in names if known.get(name) != identity.get(name)]
        if other:
            differences = "; ".join(f"{name} was {known.get(name)!r}, is {identity.get(name)!r}" for name in other)
            raise OutputError(
                f"{folder} holds work that was begun otherwise ({differences}); go on with the same settings and "
                "recording, begin anew (--fresh), or choose another output"
            )
        return True
    folder.mkdir(parents=True, exist_ok=True)
    _write_json(folder / _IDENTITY, identity)
    return False


def remember(folder: Path, words: Sequence[str]) -> None:
    """Keep the words of the command that work was begun with, and where it was given."""
    _write_json(folder / _COMMAND, {"words": list(words), "folder": str(Path.cwd())})


def command_of(folder: Path) -> tuple[list[str], str]:
    """Return the words of the command that work was begun with, and where it was given; no words where a script has.

    Raises
    ------
    OutputError
        What is kept of it is damaged.
    """
    if not (folder / _COMMAND).exists():
        return [], ""
    told = _told(folder / _COMMAND, dict)
    words, place = told.get("words"), told.get("folder")
    if not (isinstance(words, list) and all(isinstance(word, str) for word in words) and isinstance(place, str)):
        raise OutputError(f"{folder / _COMMAND} is damaged; give the command again that the work was begun with")
    return words, place


def check_unused(folder: Path) -> None:
    """Refuse a folder for work that somebody else uses.

    Raises
    ------
    OutputError
        It is no folder, or something is in it that is not of work.
    """
    if is_begun(folder) or not os.path.lexists(folder):
        return
    if not folder.is_dir():
        raise OutputError(f"{folder} is no folder; choose another output, or move it")
    others = [path.name for path in folder.iterdir() if not is_partial(path)]
    if others:
        raise OutputError(
            f"{folder} holds something else, such as {others[0]}; choose a folder that is new or empty, or move that"
        )


def is_begun(folder: Path) -> bool:
    """Whether work was begun in a folder and is not finished."""
    return (folder / _IDENTITY).exists()


def forget(folder: Path) -> None:
    """Let a folder be one in which no work was begun."""
    for name in (_IDENTITY, _OUTPUTS, _COMMAND):
        remove(folder / name)


def own(folder: Path, paths: Sequence[Path]) -> None:
    """Let work write to paths, none of which may be there, unless this work has made it.

    Raises
    ------
    OutputError
        Something of others is there.
    """
    known = _owned(folder)
    for path in paths:
        if path not in known:
            check_free(path)
    _write_json(folder / _OUTPUTS, [str(path) for path in dict.fromkeys([*known, *paths])])


def discard(folder: Path, is_ours: Callable[[Path], bool]) -> None:
    """Remove work that was begun, and what it had begun to write.

    Parameters
    ----------
    folder : Path
        Of the work. Somebody else may have made it.
    is_ours : callable
        Whether a path may be removed where the folder says that it was begun there.
    """
    for path in filter(is_ours, _owned(folder)):
        remove(path)
    finish(folder)


def finish(folder: Path) -> None:
    """Remove the folder of work that is done, at once for whoever looks for it."""
    if folder.exists():
        gone = folder.with_name(f".{folder.name}.gone")
        remove(gone)
        folder.rename(gone)
        remove(gone)


def remove(path: Path) -> None:
    """Remove a file, a folder or a link, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _owned(folder: Path) -> list[Path]:
    file = folder / _OUTPUTS
    return [Path(str(path)) for path in _told(file, list)] if file.exists() else []


def _told(path: Path, kind: type[Any]) -> Any:
    value = read_json(path)
    if not isinstance(value, kind):
        raise OutputError(f"{path} is not of napari-fiberburst, or is damaged; remove its folder, and begin anew")
    return value


def _write_json(path: Path, value: Any) -> None:
    with write_whole(path) as stream:
        stream.write(json.dumps(value, indent=2).encode())
