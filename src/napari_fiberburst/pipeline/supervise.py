"""One supervisor for every method: its clock, stop, pause, time budget and reports."""

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.control import Control
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.results.diagnostics import Ending
from napari_fiberburst.results.progress import Progress
from napari_fiberburst.results.reconstruction import Reconstruction
from napari_fiberburst.settings import Settings

# Reports make the host wait for the device, so there are few of them, and more would not be seen.
_SECONDS_BETWEEN_REPORTS = 0.1
# Drawing an image asks a network for every pixel: a fit waits until that is this part of its time, or no longer than so
# many seconds where that leaves at least so many times as long for the fit itself, because somebody is watching.
_PREVIEWS_SHARE = 0.05
_LONGEST_WAIT, _LEAST_FOR_THE_FIT = 1.3, 3.0

Draw = Callable[[], NDArray[np.float32]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """Where a method stands.

    Attributes
    ----------
    step, planned : int
        Steps done, and how many there will be, as far as that is known.
    loss : float
        As in `Progress`.
    homographies : numpy.ndarray
        (T, 3, 3), frame-t pixel to the reference frame's pixel.
    settings : Settings
        What the method goes on with.
    canvas : Canvas
        Where the image lies.
    draw : callable or None
        Draws the image as of now; None where there is none yet, or no new one.
    is_milestone : bool
        Whether the image is new because a stage has ended, and therefore always shown; the image of a network
        changes with every step, and is shown from time to time.
    held_out_rmse : float or None
        As in `Progress`.
    """

    step: int
    planned: int
    loss: float
    homographies: NDArray[np.float64]
    settings: Settings
    canvas: Canvas
    draw: Draw | None
    is_milestone: bool
    held_out_rmse: float | None = None


class Clock:
    """The time of a run, pauses left out, and when it is due to be looked at."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._reported = 0.0
        self._first_step = 0.0

    @property
    def seconds(self) -> float:
        """Seconds since the run began, pauses left out."""
        return time.perf_counter() - self._started

    def leave_out(self, seconds: float) -> None:
        """Take a pause out of the time."""
        self._started += seconds

    def is_report_due(self) -> bool:
        """Whether it is time to report: at most some ten times a second."""
        return self.seconds - self._reported >= _SECONDS_BETWEEN_REPORTS

    def start_steps(self) -> None:
        """Count the rate of steps from now on: the first step, which loads much, is done."""
        self._first_step = self.seconds

    def report(self) -> float:
        """Note that a report is made now; return the time."""
        self._reported = self.seconds
        return self._reported

    def rate(self, step: int) -> float:
        """Return steps a second since the first one ended; 0 until the second."""
        return (step - 1) / max(self.seconds - self._first_step, 1e-9) if step > 1 else 0.0


class Fit(Protocol):
    """A way to fit a burst, in steps."""

    def steps(self, clock: Clock) -> Generator[Snapshot | None, None, Ending]:
        """Do the steps; yields after each, a snapshot where there is something to report; returns how it ended."""

    def conclude(self, ending: Ending) -> tuple[Snapshot | None, Ending]:
        """Round off what there is, wherever the steps have ended, and say how they did in the end.

        There is no snapshot where not even one step was done.
        """

    def result(self, ending: Ending, seconds: float) -> Reconstruction:
        """Return the reconstruction, after `conclude`."""


def supervise(
    fit: Fit, settings: Settings, control: Control, should_stop: Callable[[], bool] | None
) -> Generator[Progress, None, Reconstruction]:
    """Run a fit until it is done, stopped or out of time, and report while it runs.

    A stop, a pause and the time budget take effect between any two steps, those of calibration included. The budget
    leaves time for one step.
    """
    clock = Clock()
    previews = _Previews(settings.preview_every)
    steps = fit.steps(clock)
    ending: Ending = "finished"
    is_started = False
    while True:
        paused = clock.seconds
        control.wait_while_paused(should_stop)
        clock.leave_out(clock.seconds - paused)
        if control.stopped or (should_stop is not None and should_stop()):
            ending = "stopped"
            break
        if is_started and settings.time_budget is not None and clock.seconds >= settings.time_budget:
            ending = "time budget"
            break
        try:
            snapshot = next(steps)
        except StopIteration as end:
            ending = end.value
            break
        if not is_started:
            clock.start_steps()
            is_started = True
        if snapshot is not None:
            yield _progress(snapshot, clock, settings, previews.taken(snapshot, clock))
    last, ending = fit.conclude(ending)
    if last is not None:
        preview = None if last.draw is None or settings.preview_every is None else last.draw()
        yield _progress(last, clock, settings, preview, is_last=True)
    return fit.result(ending, clock.seconds)


def _progress(
    snapshot: Snapshot, clock: Clock, settings: Settings, preview: NDArray[np.float32] | None, *, is_last: bool = False
) -> Progress:
    rate = clock.rate(snapshot.step)
    now = clock.report()
    limits = [] if settings.time_budget is None else [max(0.0, settings.time_budget - now)]
    if rate > 0:
        limits.append(max(0, snapshot.planned - snapshot.step) / rate)
    return Progress(
        step=snapshot.step,
        iterations=snapshot.step if is_last and snapshot.is_milestone else snapshot.planned,
        loss=snapshot.loss,
        seconds=now,
        rate=rate,
        remaining=0.0 if is_last else min(limits, default=None),
        homographies=snapshot.homographies,
        settings=snapshot.settings,
        canvas=snapshot.canvas,
        preview=preview,
        held_out_rmse=snapshot.held_out_rmse,
    )


class _Previews:
    """When images are drawn."""

    def __init__(self, every: float | None) -> None:
        self._every = every
        self._drawn = self._cost = 0.0

    def taken(self, snapshot: Snapshot, clock: Clock) -> NDArray[np.float32] | None:
        """Return the image where one is wanted now."""
        if self._every is None or snapshot.draw is None:
            return None
        before = clock.seconds
        if not snapshot.is_milestone and before - self._drawn < max(self._every, self._wait):
            return None
        image = snapshot.draw()
        self._drawn = clock.seconds
        self._cost = self._drawn - before
        return image

    @property
    def _wait(self) -> float:
        """Seconds from one image to the next that watching is worth, by what the last one has cost."""
        longest = max(_LONGEST_WAIT, self._cost * _LEAST_FOR_THE_FIT)
        return min(self._cost / _PREVIEWS_SHARE, longest)
