"""What tells a live source the time: the machine's clock, or one that goes on only when it is told to."""

import time
from typing import Protocol


class Clock(Protocol):
    """Tells the time and waits, in seconds."""

    def now(self) -> float:
        """Return seconds since some moment; they never go back."""
        ...

    def wait(self, seconds: float) -> None:
        """Return when so many seconds have gone by."""
        ...


class RealClock:
    """The machine's own."""

    def now(self) -> float:
        """Return seconds since some moment."""
        return time.perf_counter()

    def wait(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(seconds)


class SimulatedClock:
    """Goes on by what is waited for, and by nothing else, so that hours pass at once and tests know the time."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Return seconds that were waited for."""
        return self._now

    def wait(self, seconds: float) -> None:
        """Go on by so many seconds."""
        self._now += seconds
