"""Networks at work: steps of Adam, the states a run can go back to, and when it has learned enough."""

import logging
from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.control import Control
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.networks.image import Representation
from napari_fiberburst.networks.training import BehindBundle, Problem, State
from napari_fiberburst.pipeline.diagnose import diagnose
from napari_fiberburst.pipeline.spline import SplineFit
from napari_fiberburst.pipeline.stages import Fitted
from napari_fiberburst.pipeline.supervise import Clock, Snapshot
from napari_fiberburst.results.reconstruction import Ending, Reconstruction, draw
from napari_fiberburst.settings import Fourier, Settings

logger = logging.getLogger(__name__)

# Keeping a state copies the networks and Adam's moments.
_SECONDS_BETWEEN_KEPT_STATES = 1.0
_PUBLISHED_ITERATIONS, _BUNDLE_ITERATIONS = 3000, 2000
# Early stopping: a fit without an end of its own ends once the error of held-out samples has not improved for this
# part of its steps.
_PATIENCE, _LEAST_PATIENCE = 0.4, 150
# Spread of the Fourier features' frequencies, cycles per pitch: detail between cores is resolved, noise hardly.
_PERIODS_PER_PITCH = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """A state to go back to, after `step` steps."""

    step: int
    settings: Settings
    state: State


class NetworkFit:
    """A fit of networks behind the bundle: align, then train; see `napari_fiberburst.pipeline.supervise.Method`.

    Parameters
    ----------
    burst, settings, initial, control
        As in `napari_fiberburst.iterate`.
    aligned : SplineFit
        That aligns the burst.
    """

    def __init__(
        self,
        burst: Burst,
        settings: Settings,
        device: torch.device,
        control: Control,
        initial: Reconstruction | None,
        aligned: SplineFit,
    ) -> None:
        self._burst, self._settings, self._device = burst, settings, device
        self._control, self._initial = control, initial
        self._aligned = aligned
        self._training: Training | None = None

    def steps(self, clock: Clock) -> Generator[Snapshot | None, None, Ending]:
        """Align, then train."""
        yield from self._aligned.align()
        return (yield from self._start().steps(clock))

    def conclude(self, ending: Ending) -> tuple[Snapshot | None, Ending]:
        """Take the best state there is."""
        return (self._training or self._start()).conclude(ending)

    def result(self, ending: Ending, seconds: float) -> Reconstruction:
        """Return the reconstruction."""
        assert self._training is not None
        return self._training.result(ending, seconds)

    def _start(self) -> "Training":
        """Set up the networks where the alignment has come to."""
        fitted = self._aligned.round_off()
        settings = _following_pitch(self._settings, fitted)
        self._training = Training(self._burst, settings, self._device, self._control, self._initial, fitted)
        return self._training


class Training:
    """Steps of Adam on a burst as published, or behind its bundle; see `napari_fiberburst.pipeline.supervise.Method`.

    Parameters
    ----------
    burst, settings, initial, control
        As in `napari_fiberburst.iterate`.
    fitted : Fitted, optional
        The burst, calibrated and registered, with a first picture; without, it is fitted as published.
    """

    def __init__(
        self,
        burst: Burst,
        settings: Settings,
        device: torch.device,
        control: Control,
        initial: Reconstruction | None,
        fitted: Fitted | None = None,
    ) -> None:
        self._burst, self._device, self._control, self._initial = burst, device, control, initial
        self._fitted = fitted
        behind = None
        if fitted is not None:
            assert fitted.samples is not None
            behind = BehindBundle(fitted.samples, fitted.registration.reference_from_frame)
        self._problem = Problem(burst, settings, device, initial, behind)
        self._settings = replace(settings, learning_rate=self._problem.learning_rate)
        bounds = (0, 0, burst.shape[2], burst.shape[1])
        self._canvas = Canvas.over(bounds, settings.upsample) if fitted is None else fitted.canvas
        self._iterations = settings.iterations or (_PUBLISHED_ITERATIONS if fitted is None else _BUNDLE_ITERATIONS)
        self._best: tuple[float, _Kept] | None = None
        self._losses: list[float] = []
        self._pending: list[Tensor] = []
        self._kept: tuple[_Kept, ...] = (_Kept(0, self._settings, self._problem.state()),)
        self._kept_at = 0.0
        self._live_sigma: float | None = None
        self._image: NDArray[np.float32] | None = None
        self._has_open_end = settings.iterations is None
        self._step = 0

    def steps(self, clock: Clock) -> Generator[Snapshot | None, None, Ending]:
        """Take steps until there are enough."""
        while self._step < self._iterations:
            self._follow()
            # The loss stays on the device until someone looks.
            self._pending.append(self._problem.step())
            self._step += 1
            if self._step == 1:
                clock.start_steps()
            is_due = (self._step == 1 or clock.is_report_due()) and self._step < self._iterations
            if not is_due:
                yield None
                continue
            if not self._check_and_keep(clock):
                return "diverged"
            has_converged = self._evaluate_held_out()
            yield self._snapshot()
            if has_converged:
                break
        return "finished"

    def conclude(self, ending: Ending) -> tuple[Snapshot | None, Ending]:
        """Take the state with the least error of held-out samples, and make sure that it can be drawn."""
        if self._best is not None and ending != "diverged":
            self._evaluate_held_out()
            self._problem.restore(self._best[1].state)
        if ending != "diverged" and self._check_and_keep(None):
            self._image = self._draw()
            if not np.isfinite(self._image).all():  # no loss was taken after the last step to tell
                self._go_back()
                ending = "diverged"
                self._image = self._draw()
        else:
            ending = "diverged"
            self._image = self._draw()
        return (self._snapshot() if self._step else None), ending

    def result(self, ending: Ending, seconds: float) -> Reconstruction:
        """Return the reconstruction."""
        assert self._image is not None
        representation = self._representation()
        losses = np.array(self._losses, dtype=np.float32)
        before = self._initial
        return Reconstruction(
            image=self._image,
            canvas=self._canvas,
            homographies=representation.homographies(),
            losses=losses if before is None else np.concatenate([before.losses, losses]),
            settings=self._settings,
            seconds=seconds + (0.0 if before is None else before.seconds),
            parameters=self._problem.field.parameter_count,
            device=str(self._device),
            ending=ending,
            acquisition=self._burst.acquisition,
            renderer=representation,
            **self._diagnostics(),
        )

    def _diagnostics(self) -> dict[str, Any]:
        fitted = self._fitted
        if fitted is None:
            return {}
        assert fitted.scene is not None
        found = diagnose(
            self._burst,
            fitted.bundle,
            fitted.registration,
            fitted.scene,
            fitted.canvas,
            notes=fitted.all_notes,
            is_scene_shown=False,
        )
        return {**found.by_name(), "sample_error": self._error_in_units()}

    def _follow(self) -> None:
        """Take over what a user has changed since the last step."""
        rate, sigma = self._control.learning_rate, self._control.sigma
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

    def _check_and_keep(self, clock: Clock | None) -> bool:
        """Return whether all losses and parameters are numbers, and keep such a state; else go back to one."""
        if self._pending:
            self._losses += torch.stack(self._pending).tolist()
            self._pending.clear()
        if not (np.isfinite(self._losses).all() and self._problem.is_finite()):
            self._go_back()
            return False
        if clock is not None and clock.seconds - self._kept_at >= _SECONDS_BETWEEN_KEPT_STATES:
            self._kept = (self._kept[-1], _Kept(self._step, self._settings, self._problem.state()))
            self._kept_at = clock.seconds
        return True

    def _evaluate_held_out(self) -> bool:
        """Take the error of held-out samples, keep the state where it is the least; return whether it has converged."""
        error = self._problem.sample_error()
        if error is None:
            return False
        if self._best is None or error < self._best[0]:
            self._best = (error, _Kept(self._step, self._settings, self._problem.state()))
        waited = self._step - self._best[1].step
        return self._has_open_end and waited > max(_LEAST_PATIENCE, _PATIENCE * self._step)

    def _snapshot(self) -> Snapshot:
        return Snapshot(
            step=self._step,
            planned=self._iterations,
            loss=self._losses[-1],
            homographies=self._representation().homographies(),
            settings=self._settings,
            canvas=self._canvas,
            draw=self._draw,
            is_milestone=False,
            held_out_rmse=self._error_in_units(),
        )

    def _error_in_units(self) -> float | None:
        return None if self._best is None else self._best[0] * (self._burst.white_level - self._burst.black_level)

    def _representation(self) -> Representation:
        return self._problem.representation(None if self._fitted is None else self._fitted.image)

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
            self._step,
            back.step,
            self._settings.learning_rate or 0.0,
        )
        self._problem.restore(back.state)
        self._settings = back.settings
        self._losses = self._losses[: back.step]
        self._step = back.step

    def _draw(self) -> NDArray[np.float32]:
        reference = 0 if self._fitted is None else self._fitted.registration.reference
        return draw(self._representation(), self._canvas, reference, self._burst)


def _following_pitch(settings: Settings, fitted: Fitted) -> Settings:
    """Return the settings with the frequency spread that suits the bundle, where it is left open."""
    encoding = settings.encoding
    if not isinstance(encoding, Fourier) or encoding.sigma is not None:
        return settings
    sigma = _PERIODS_PER_PITCH * max(fitted.bundle.shape) / 2 / fitted.bundle.pitch
    return replace(settings, encoding=replace(encoding, sigma=sigma))
