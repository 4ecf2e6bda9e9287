"""Work on a recording in units, each a plain function that writes its own file: here, on several processes, or again.

A unit that is done leaves a marker. Work that was cut short goes on with the units that have none, and comes to the
same bits as work that was not, because no unit depends on the order in which others are done.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.results import write_whole

_IDENTITY = "work.json"


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
        """Return the file whose presence says that a unit is done."""
        return self.folder / stage / f"{number:06d}.done"


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
    if client is None:
        for done, number in enumerate(left, start=1):
            _do(unit, stage, work, number)
            yield number, len(left) - done
        return
    from distributed import as_completed  # an extra

    shared = client.scatter(work, broadcast=True)
    keys = [f"{stage}-{number}-{work.folder.name}" for number in left]
    futures = client.map(_do_for, [(unit, stage, number) for number in left], work=shared, key=keys, retries=3)
    for done, future in enumerate(as_completed(futures), start=1):  # type: ignore[no-untyped-call]
        yield future.result(), len(left) - done


def _do(unit: Unit, stage: str, work: Work, number: int) -> int:
    unit(work, stage, number)
    work.marker(stage, number).touch()
    return number


def _do_for(asked: tuple[Unit, str, int], work: Work) -> int:
    unit, stage, number = asked
    return _do(unit, stage, work, number)


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
    file = folder / _IDENTITY
    if file.exists():
        known = json.loads(file.read_text(encoding="utf-8"))
        names = sorted(set(known) | set(identity))
        other = [name for name in names if known.get(name) != identity.get(name)]
        if other:
            differences = "; ".join(f"{name} was {known.get(name)!r}, is {identity.get(name)!r}" for name in other)
            raise OutputError(
                f"{folder} holds work that was begun otherwise ({differences}); go on with the same settings and "
                "recording, or remove that folder to begin anew"
            )
        return True
    folder.mkdir(parents=True, exist_ok=True)
    with write_whole(file) as stream:
        stream.write(json.dumps(identity, indent=2).encode())
    return False
