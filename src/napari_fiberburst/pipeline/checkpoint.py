"""Checkpoints: where a fit of networks stands, in a file from which it goes on after it was killed."""

import hashlib
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import OutputError, SettingsError
from napari_fiberburst.io.results import CHECKPOINT_ENDING, SOFTWARE
from napari_fiberburst.results.reconstruction import Reconstruction
from napari_fiberburst.settings import Settings, SplineMethod
from napari_fiberburst.stored import Arrays, Stored

logger = logging.getLogger(__name__)

SECONDS_BETWEEN = 60.0
# Settings that a run may go on with others of.
_MAY_DIFFER = ("device", "time_budget", "preview_every", "memory")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeptState:
    """A fit of networks after some steps.

    Attributes
    ----------
    step : int
        Steps done.
    method : dict
        `napari_fiberburst.settings.Settings` with the method as it was then, as plain values.
    arrays : dict
        Of the networks and of Adam, by name.
    drawn : int
        Samples drawn.
    """

    step: int
    method: dict[str, Any]
    arrays: Arrays
    drawn: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Checkpoint(Stored):
    """Where a fit of networks stands.

    Attributes
    ----------
    run : dict
        What the run is told by, by name: `told_by`.
    now : KeptState
        The newest state.
    seconds : float
        That it took.
    losses : numpy.ndarray
        (steps,) float32.
    best : KeptState or None
        The state with the least error of held-out samples; None where there are none.
    best_error : float or None
        That error, full scale 1.
    command : list of str
        Words of the command that has begun the run, for `fiberburst resume`; empty where a script has begun it.
    folder : str
        That the command was given in.
    """

    _kind: ClassVar[str] = "checkpoint"
    _ending: ClassVar[str] = CHECKPOINT_ENDING

    run: dict[str, Any]
    now: KeptState
    seconds: float
    losses: NDArray[np.float32]
    best: KeptState | None
    best_error: float | None
    command: list[str]
    folder: str

    def _check(self) -> None:
        for state in filter(None, (self.now, self.best)):
            if not all(isinstance(number, int) and number >= 0 for number in (state.step, state.drawn)):
                raise ValueError(f"steps and samples are counted from 0; got {state.step} and {state.drawn}")
            if not isinstance(state.method, dict):
                raise ValueError(f"a method must be values by name; got {type(state.method).__name__}")
        if self.losses.shape != (self.now.step,) or not np.isfinite(self.losses).all():
            raise ValueError(f"a run of {self.now.step} steps has as many losses; got {self.losses.shape}")
        if not (isinstance(self.seconds, float) and 0 <= self.seconds < math.inf):
            raise ValueError(f"a run takes a finite time; got {self.seconds}")
        if (self.best is None) != (self.best_error is None):
            raise ValueError("the best state and its error go together")
        if not isinstance(self.run, dict):
            raise ValueError(f"run must be values by name; got {type(self.run).__name__}")
        if not (isinstance(self.command, list) and all(isinstance(word, str) for word in self.command)):
            raise ValueError("the command must be words")
        if not isinstance(self.folder, str):
            raise ValueError("the folder must be a path")


class Checkpointing:
    """Keeps a run in a file from time to time, and knows what an earlier process has kept of it there.

    Parameters
    ----------
    path : str or Path
        The file, ending in ``.checkpoint``. It is written whole or not at all, so there is one at every moment.
    every : float
        Seconds from one to the next.
    command : sequence of str
        Of the run, where a command has begun it.

    Raises
    ------
    OutputError
        The path has another ending, or its folder is not there or cannot be written.
    SettingsError
        The time is not positive.

    Attributes
    ----------
    run : dict
        As in `Checkpoint`.
    found : Checkpoint or None
        What there is of this run; None where it has not been begun.
    """

    def __init__(self, path: str | Path, every: float = SECONDS_BETWEEN, command: Sequence[str] = ()) -> None:
        if isinstance(every, bool) or not isinstance(every, int | float) or not 0 < every < math.inf:
            raise SettingsError(f"checkpoint_every must be a positive number of seconds; got {every!r}")
        self._path, self._every = Checkpoint.check_output(path), float(every)
        self.command, self.folder = list(command), str(Path.cwd())
        self.run: dict[str, Any] = {}
        self.found: Checkpoint | None = None
        self._kept_at = 0.0

    def begin(self, run: dict[str, Any]) -> None:
        """Say what run this is, and look for what there is of it.

        Raises
        ------
        OutputError
            The file is of another run, and the message names what is not the same; or it is damaged.
        """
        self.run = run
        if not self._path.exists():
            return
        found = Checkpoint.load(self._path)
        other = [name for name in run if found.run.get(name) != run[name]]
        if other:
            raise OutputError(
                f"{self._path} is a checkpoint of another run (not the same: {', '.join(other)}); go on with the same, "
                "remove it, or choose another file"
            )
        self.found, self._kept_at = found, found.seconds

    def is_due(self, seconds: float) -> bool:
        """Whether it is time to keep the run again, so many seconds from its start."""
        return seconds - self._kept_at >= self._every

    def keep(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint in place of the one before; where that cannot be, as on a full disk, the run goes on."""
        self._kept_at = checkpoint.seconds
        try:
            checkpoint.save(self._path)
        except OutputError as error:
            logger.warning("the run goes on, but could not be kept: %s", error)


def check_kept(settings: Settings) -> None:
    """Refuse a checkpoint of what has none.

    Raises
    ------
    SettingsError
        The method is solved, not trained.
    """
    if isinstance(settings.method, SplineMethod):
        raise SettingsError("a spline is solved in seconds, so there is nothing to keep; leave the checkpoint out")


def told_by(burst: Burst, requested: Settings, bundle: Bundle | None, initial: Reconstruction | None) -> dict[str, Any]:
    """Return what a run is told by, as plain values: what has the same of these comes to the same bits on one CPU."""
    return {
        "burst": _digest(burst.frames, burst.black_level, burst.white_level),
        "settings": {name: value for name, value in requested.to_dict().items() if name not in _MAY_DIFFER},
        "bundle": None if bundle is None else bundle.digest(),
        "initial": None if initial is None else _digest(initial.losses, initial.image),
        "version": SOFTWARE,
    }


def _digest(*parts: Any) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(np.ascontiguousarray(part).data if isinstance(part, np.ndarray) else repr(part).encode())
    return digest.hexdigest()
