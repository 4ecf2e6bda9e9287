"""What trials count, and how a call is held to bounded time."""

import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import numpy as np

from napari_fiberburst import Burst, FiberBurstError, Reconstruction

# Seconds that any call may take on a busy machine of two cores; the inputs are tiny.
LONGEST = 60


@dataclass(slots=True)
class Count:
    """What has been tried.

    Attributes
    ----------
    name : str
        Of the trial.
    tried : int
        Inputs, runs or rounds.
    faults : int
        Faults that were put in.
    refused : int
        Inputs that were refused by an error of ours.
    losses : list of str
        What went wrong: another exception, no usable result, different bits, something that was lost.
    """

    name: str
    tried: int = 0
    faults: int = 0
    refused: int = 0
    losses: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def __str__(self) -> str:
        return (
            f"{self.name:<34} {self.tried:>6} tried {self.faults:>6} faults {self.refused:>6} refused "
            f"{len(self.losses):>3} losses {self.seconds:>6.0f} s"
        )

    def check(self, call: Callable[[], Any], is_usable: Callable[[Any], str | None], what: str) -> None:
        """Make a call; a loss is anything but a usable value or an error of ours, within bounded time.

        Parameters
        ----------
        call : callable
            Without arguments.
        is_usable : callable
            What is wrong with its value; None where nothing is.
        what : str
            The input, in words that let it be made again.
        """
        self.tried += 1
        try:
            with at_most(LONGEST):
                wrong = is_usable(call())
        except FiberBurstError as error:
            self.refused += 1
            wrong = None if str(error).strip() else "an error without a word"
        except Exception as error:  # noqa: BLE001 - whatever it is, it is none of ours
            wrong = f"{type(error).__name__}: {error} at {traceback.extract_tb(error.__traceback__)[-1]}"
        if wrong is not None:
            self.lose(f"{what}: {wrong}")

    def lose(self, what: str) -> None:
        """Note a loss, and print it."""
        self.losses.append(what)
        print(f"LOST {self.name}: {what}", file=sys.stderr, flush=True)


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """End what takes longer by TimeoutError; in the main thread alone."""

    def ring(signum: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"it took more than {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def timed(name: str, trial: Callable[[Count], None]) -> Count:
    """Do a trial, and return what it counted."""
    count, start = Count(name), time.perf_counter()
    trial(count)
    count.seconds = time.perf_counter() - start
    return count


def wrong_with(result: Reconstruction) -> str | None:
    """Return what is wrong with a result: it has to show something, and to say what it is worth."""
    if not np.isfinite(result.image).any():
        return "an image without a finite pixel"
    if np.isinf(result.image).any():
        return "an infinite pixel"
    if result.quality not in ("good", "doubtful", "bad", None):  # a network fitted as published has no verdict
        return f"a verdict of {result.quality!r}"
    if not np.isfinite(result.homographies[result.reference]).all():
        return "a reference without a place"
    return None


def wrong_with_burst(burst: Burst) -> str | None:
    """Return what is wrong with a burst; None where nothing is."""
    return None if np.isfinite(burst.frames).all() and burst.frames.ndim == 4 else "frames that are not finite"
