"""One run: its clock, its losses, its reports, and the states it can go back to."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.control import Control
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.device import find_device
from napari_fiberburst.networks.image import Representation
from napari_fiberburst.pipeline.problem import Problem, State
from napari_fiberburst.pipeline.spline import SelfCalibrated
from napari_fiberburst.results.progress import Progress
from napari_fiberburst.results.reconstruction import Canvas, Ending, Reconstruction, draw
from napari_fiberburst.settings import Fourier, Settings

logger = logging.getLogger(__name__)

# Reports make the host wait for the device, so there are few of them, and more would not be seen.
_SECONDS_BETWEEN_REPORTS = 0.1
# Drawing a picture asks the network for every pixel: watching must not slow a fit that is watched.
_PREVIEWS_SHARE = 0.05
# Keeping a state copies the networks and Adam's moments.
_SECONDS_BETWEEN_KEPT_STATES = 1.0
_PUBLISHED_ITERATIONS, _OBSERVED_ITERATIONS = 3000, 2000
# Without an end of its own, a fit ends once the samples left out have not been met better for this part of its steps.
_PATIENCE, _LEAST_PATIENCE = 0.4, 150


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """A state to go back to, after `step` steps."""

    step: int
    settings: Settings
    state: State


class Run:
    """The bookkeeping of one run.

    Parameters
    ----------
    burst, settings, initial
        As in `napari_fiberburst.iterate`.
    prepared : SelfCalibrated, optional
        The burst, calibrated and registered, with a first picture; without, it is fitted as published.

    Attributes
    ----------
    step : int
        Steps done.
    ending : str
        Why the run ended, once it has.
    """

    def __init__(
        self,
        burst: Burst,
        settings: Settings,
        initial: Reconstruction | None,
        prepared: SelfCalibrated | None = None,
    ) -> None:
        self._burst = burst
        self._settings = settings
        self._initial = initial
        self._prepared = prepared
        self._device = find_device(settings.device)
        aligned = None if prepared is None else prepared.alignment
        self._problem = Problem(burst, settings, self._device, initial, aligned)
        self._settings = replace(settings, learning_rate=self._problem.learning_rate)
        bounds = (0, 0, burst.shape[2], burst.shape[1])
        self._canvas = Canvas.over(bounds, settings.upsample) if prepared is None else prepared.canvas
        self.iterations = settings.iterations or (_OBSERVED_ITERATIONS if prepared else _PUBLISHED_ITERATIONS)
        self._best: tuple[float, _Kept] | None = None
        self._losses: list[float] = []
        self._pending: list[Tensor] = []
        self._kept: tuple[_Kept, ...] = (_Kept(0, self._settings, self._problem.state()),)
        self._live_sigma: float | None = None
        self._first_done = self._reported = self._previewed = self._drawing = self._kept_at = 0.0
        self.step = 0
        self.ending: Ending = "finished"
        # The first set-up in a process loads much of torch, which is not the run's to answer for.
        self._started = time.perf_counter() - (0.0 if prepared is None else prepared.seconds)

    @property
    def seconds(self) -> float:
        """Time since the start, pauses left out."""
        return time.perf_counter() - self._started

    def hold_while_paused(self, control: Control, should_stop: Callable[[], bool] | None) -> None:
        """Wait while the run is paused, and take the wait out of its time."""
        paused_at = time.perf_counter()
        control.wait_while_paused(should_stop)
        self._started += time.perf_counter() - paused_at

    def is_out_of_time(self) -> bool:
        """Whether the time budget is spent; never before the first step."""
        budget = self._settings.time_budget
        return budget is not None and self.step > 0 and self.seconds >= budget

    def follow(self, control: Control) -> None:
        """Take over what a user has changed since the last step."""
        rate, sigma = control.learning_rate, control.sigma
        if rate is not None and rate != self._settings.learning_rate:
            self._problem.set_learning_rate(rate)
            self._settings = replace(self._settings, learning_rate=rate)
        if sigma is None or sigma == self._live_sigma:
            return
        self._live_sigma = sigma
        encoding = self._settings.encoding
        if isinstance(encoding, Fourier):
            self._problem.field.scene.set_sigma(sigma)
            self._settings = replace(self._settings, encoding=replace(encoding, sigma=sigma))
        else:
            logger.warning("sigma %g has no effect: encoding %s has no frequency spread", sigma, encoding.name)

    def advance(self) -> None:
        """Take one step. The loss stays on the device until someone looks."""
        self._pending.append(self._problem.step())
        self.step += 1
        if self.step == 1:
            self._first_done = self.seconds

    def is_report_due(self) -> bool:
        """Whether it is time to look; the last step is reported at the end."""
        due = self.step == 1 or self.seconds - self._reported >= _SECONDS_BETWEEN_REPORTS
        return due and self.step < self.iterations

    def is_healthy(self) -> bool:
        """Whether all losses and all parameters are numbers; else go back to when they were."""
        if self._pending:
            self._losses += torch.stack(self._pending).tolist()
            self._pending.clear()
        if np.isfinite(self._losses).all() and self._problem.is_finite():
            if self.seconds - self._kept_at >= _SECONDS_BETWEEN_KEPT_STATES:
                self._kept = (self._kept[-1], _Kept(self.step, self._settings, self._problem.state()))
                self._kept_at = self.seconds
            return True
        self._go_back()
        return False

    def has_converged(self) -> bool:
        """Look at the samples that were left out, and whether they have stopped being met better."""
        error = self._problem.sample_error()
        if error is None:
            return False
        if self._best is None or error < self._best[0]:
            self._best = (error, _Kept(self.step, self._settings, self._problem.state()))
        waited = self.step - self._best[1].step
        return self._settings.iterations is None and waited > max(_LEAST_PATIENCE, _PATIENCE * self.step)

    def finish(self) -> None:
        """Take the state that meets the samples left out best, and make sure that it can be drawn."""
        if self._best is not None and self.ending != "diverged":
            self.has_converged()
            self._problem.restore(self._best[1].state)
        if self.ending != "diverged" and self.is_healthy():
            self._image = self._picture()
            if np.isfinite(self._image).all():
                return
            self._go_back()  # no loss was taken after the last step to tell
        self._image = self._picture()

    def report(self, *, last: bool = False) -> Progress:
        """Return where the run stands."""
        settings = self._settings
        preview = self._image if last and settings.preview_every is not None else None
        if not last and self._is_preview_due():
            drawing = self.seconds
            preview = self._picture()
            self._previewed, self._drawing = self.seconds, self.seconds - drawing
        now = self._reported = self.seconds
        rate = (self.step - 1) / (now - self._first_done) if self.step > 1 else 0.0
        return Progress(
            step=self.step,
            iterations=self.iterations,
            loss=self._losses[-1],
            seconds=now,
            rate=rate,
            remaining=0.0 if last else self._remaining(rate, now),
            homographies=self._representation().homographies(),
            settings=settings,
            canvas=self._canvas,
            preview=preview,
            sample_error=self._error_in_units(),
        )

    def _is_preview_due(self) -> bool:
        wanted = self._settings.preview_every
        return wanted is not None and self.seconds - self._previewed >= max(wanted, self._drawing / _PREVIEWS_SHARE)

    def result(self) -> Reconstruction:
        """Return what the run has come to."""
        representation = self._representation()
        losses = np.array(self._losses, dtype=np.float32)
        before = self._initial
        return Reconstruction(
            image=self._image,
            canvas=self._canvas,
            homographies=representation.homographies(),
            losses=losses if before is None else np.concatenate([before.losses, losses]),
            settings=self._settings,
            seconds=self.seconds + (0.0 if before is None else before.seconds),
            parameters=self._problem.field.parameter_count,
            device=str(self._device),
            ending=self.ending,
            acquisition=self._burst.acquisition,
            renderer=representation,
            sample_error=self._error_in_units(),
            **({} if self._prepared is None else self._prepared.bundle_evidence()),
        )

    def _error_in_units(self) -> float | None:
        return None if self._best is None else self._best[0] * (self._burst.white_level - self._burst.black_level)

    def _representation(self) -> Representation:
        representation = self._problem.representation()
        representation.behind = None if self._prepared is None else self._prepared.picture
        return representation

    def _remaining(self, rate: float, now: float) -> float | None:
        budget = self._settings.time_budget
        limits = [] if budget is None else [max(0.0, budget - now)]
        if rate > 0:
            limits.append((self.iterations - self.step) / rate)
        return min(limits, default=None)

    def _go_back(self) -> None:
        """Return to the newest kept state that is known to be good.

        The loss of a step is taken before the step, so a state is known to be good by the loss that came next.
        """
        failed = np.flatnonzero(~np.isfinite(self._losses))
        first_bad = int(failed[0]) if failed.size else len(self._losses)
        good = [kept for kept in self._kept if kept.step < first_bad]
        back = good[-1] if good else self._kept[0]
        logger.warning(
            "the fit stopped giving numbers by step %d; going back to step %d; a learning rate lower than %g may help",
            self.step,
            back.step,
            self._settings.learning_rate or 0.0,
        )
        self._problem.restore(back.state)
        self._settings = back.settings
        self._losses = self._losses[: back.step]
        self.step = back.step
        self.ending = "diverged"

    def _picture(self) -> NDArray[np.float32]:
        reference = 0 if self._prepared is None else self._prepared.alignment.reference
        return draw(self._representation(), self._canvas, reference, self._burst)
