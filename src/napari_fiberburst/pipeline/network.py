"""Networks at work: steps of Adam, the states a run can go back to, and when it has learned enough."""

import logging
import math
from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.control import Control, Region
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.errors import OutputError
from napari_fiberburst.memory import MemoryLimit
from napari_fiberburst.networks.image import Representation
from napari_fiberburst.networks.training import BehindBundle, Problem, State
from napari_fiberburst.pipeline.checkpoint import Checkpoint, Checkpointing, KeptState
from napari_fiberburst.pipeline.diagnose import diagnose
from napari_fiberburst.pipeline.fitted import Fitted
from napari_fiberburst.pipeline.spline import SplineFit
from napari_fiberburst.pipeline.supervise import Clock, Snapshot
from napari_fiberburst.results.diagnostics import Ending
from napari_fiberburst.results.reconstruction import Reconstruction, draw
from napari_fiberburst.settings import (
    Fourier,
    NetworkMethod,
    PublishedMethod,
    Settings,
    SplineMethod,
    TrainedMethod,
)

logger = logging.getLogger(__name__)

# Keeping a state copies the networks and Adam's moments.
_SECONDS_BETWEEN_KEPT_STATES = 1.0
_ITERATIONS = 2000
# The error of held-out samples is taken at steps of fixed numbers: the state that is kept must not depend on the clock.
_STEPS_BETWEEN_EVALUATIONS = 10
# Early stopping: a fit without an end of its own ends once the error of held-out samples has not improved for this
# part of its steps.
_PATIENCE, _LEAST_PATIENCE = 0.4, 150
# A region is favoured for this part of the steps; then all is learned alike again, and the rest does not stay behind.
_FAVOURED_PART = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """A state to go back to, after `step` steps."""

    step: int
    method: TrainedMethod
    state: State


class NetworkFit:
    """A fit of networks behind the bundle: align, then train; see `napari_fiberburst.pipeline.supervise.Fit`.

    Parameters
    ----------
    burst : Burst
        What to fit.
    requested : Settings
        What was asked for.
    method : NetworkMethod
        The method asked for.
    device : torch.device
        Where.
    control, initial, given, keeper
        As control, initial, bundle and checkpointing of `napari_fiberburst.iterate`.
    """

    def __init__(
        self,
        burst: Burst,
        requested: Settings,
        method: NetworkMethod,
        device: torch.device,
        control: Control,
        initial: Reconstruction | None,
        given: Bundle | None,
        keeper: Checkpointing | None,
    ) -> None:
        self._keeper = keeper
        self._burst, self._requested, self._method, self._device = burst, requested, method, device
        self._control, self._initial = control, initial
        self._limit = MemoryLimit(burst.shape, requested)
        self._aligned = SplineFit(burst, requested, method.alignment, device, given, self._limit)
        self._training: Training | None = None

    def steps(self, clock: Clock) -> Generator[Snapshot | None, None, Ending]:
        """Align, then train."""
        for snapshot in self._aligned.align():
            yield None if snapshot is None else replace(snapshot, settings=self._chosen(self._aligned.fitted))
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
        assert fitted.samples is not None
        samples = fitted.registration.correct(fitted.samples)
        behind = BehindBundle(
            samples,
            fitted.recorded.reference_from_frame,
            self._method.held_out,
            None if fitted.mount is None else fitted.mount.offsets,
        )
        method = replace(self._method, samples=fitted.samples.kind)
        problem = Problem(
            self._burst,
            method,
            self._device,
            seed=self._requested.seed,
            initial=self._initial,
            behind=behind,
            parts=self._limit.parts(samples.kind, len(samples.positions)),
        )
        self._training = Training(
            self._burst, self._requested, problem, self._device, self._control, self._initial, self._keeper, fitted
        )
        return self._training

    def _chosen(self, fitted: Fitted) -> Settings:
        """Return the settings with all that the alignment has chosen."""
        samples = self._method.samples if fitted.samples is None else fitted.samples.kind
        return replace(self._requested, method=replace(self._method, samples=samples), device=str(self._device))


def published(
    burst: Burst,
    requested: Settings,
    method: PublishedMethod,
    device: torch.device,
    control: Control,
    initial: Reconstruction | None,
    keeper: Checkpointing | None,
) -> "Training":
    """Return a fit of networks to the frames as they are; the parameters are those of `NetworkFit`."""
    parts = MemoryLimit(burst.shape, requested).parts()
    problem = Problem(burst, method, device, seed=requested.seed, initial=initial, parts=parts)
    return Training(burst, requested, problem, device, control, initial, keeper)


class Training:
    """Steps of Adam on a burst as published, or behind its bundle; see `napari_fiberburst.pipeline.supervise.Fit`.

    Parameters
    ----------
    burst : Burst
        What is fitted.
    requested : Settings
        What was asked for.
    problem : Problem
        The networks in the making.
    device : torch.device
        Where.
    control, initial, keeper
        As control, initial and checkpointing of `napari_fiberburst.iterate`.
    fitted : Fitted, optional
        The burst, calibrated and registered, with a first image; without, it is fitted as published.
    """

    def __init__(
        self,
        burst: Burst,
        requested: Settings,
        problem: Problem,
        device: torch.device,
        control: Control,
        initial: Reconstruction | None,
        keeper: Checkpointing | None,
        fitted: Fitted | None = None,
    ) -> None:
        self._burst, self._requested, self._device, self._control = burst, requested, device, control
        self._initial, self._fitted, self._problem = initial, fitted, problem
        bounds = (0, 0, burst.shape[2], burst.shape[1])
        self._canvas = Canvas.over(bounds, problem.method.upsample) if fitted is None else fitted.canvas
        self._has_open_end = problem.method.iterations is None
        self._iterations = problem.method.iterations or _ITERATIONS
        self._before = 0 if initial is None else len(initial.losses)
        self._method: TrainedMethod = replace(problem.method, iterations=self._before + self._iterations)
        self._best: tuple[float, _Kept] | None = None
        self._losses: list[float] = []
        self._pending: list[Tensor] = []
        self._kept: tuple[_Kept, ...] = (_Kept(0, self._method, self._problem.state()),)
        self._kept_at = 0.0
        self._live_sigma: float | None = None
        self._live_region: Region | None = None
        self._favoured_until = 0.0
        self._image: NDArray[np.float32] | None = None
        self._step = 0
        self._keeper = keeper
        self._clock: Clock | None = None
        if keeper is not None and keeper.found is not None:
            self._go_on_from(keeper.found)

    def steps(self, clock: Clock) -> Generator[Snapshot | None, None, Ending]:
        """Take steps until there are enough."""
        self._clock = clock
        if self._keeper is not None and self._keeper.found is not None:
            clock.leave_out(-self._keeper.found.seconds)  # time goes on from where it was
        while self._step < self._iterations:
            self._follow()
            # The loss stays on the device until someone looks.
            self._pending.append(self._problem.step())
            self._step += 1
            if self._step == 1:
                clock.start_steps()
            if self._step % _STEPS_BETWEEN_EVALUATIONS == 1 and self._evaluate_held_out():
                break
            if self._keeper is not None and self._keeper.is_due(clock.seconds) and not self._keep_in_file(clock):
                return "diverged"
            is_due = (self._step == 1 or clock.is_report_due()) and self._step < self._iterations
            if not is_due:
                yield None
                continue
            if not self._check_and_keep(clock):
                return "diverged"
            yield self._snapshot()
        return "finished"

    def conclude(self, ending: Ending) -> tuple[Snapshot | None, Ending]:
        """Take the state with the least error of held-out samples, and make sure that it can be drawn."""
        if ending == "stopped" and self._clock is not None and self._step:
            self._keep_in_file(self._clock)
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
        if self._before + self._step:
            self._method = replace(self._method, iterations=self._before + self._step)
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
            requested=self._requested,
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
        return {**found.by_name(), "held_out_rmse": self._error_in_units()}

    def _follow(self) -> None:
        """Take over what a user has changed since the last step."""
        rate, sigma, region = self._control.learning_rate, self._control.sigma, self._control.region
        if region != self._live_region:
            self._live_region = region
            self._favoured_until = self._step + _FAVOURED_PART * self._iterations
            self._problem.samples.favour(region, self._representation().homographies())
        elif region is not None and self._step > self._favoured_until:
            self._problem.samples.favour(None, self._representation().homographies())
            self._favoured_until = math.inf
        if rate is not None and rate != self._method.learning_rate:
            self._problem.set_learning_rate(rate)
            self._method = replace(self._method, learning_rate=rate)
        if sigma is None or sigma == self._live_sigma:
            return
        self._live_sigma = sigma
        encoding = self._method.encoding
        if isinstance(encoding, Fourier):
            self._problem.field.scene.set_sigma(sigma)
            self._method = replace(self._method, encoding=replace(encoding, sigma=sigma))
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
            self._kept = (self._kept[-1], _Kept(self._step, self._method, self._problem.state()))
            self._kept_at = clock.seconds
        return True

    def _evaluate_held_out(self) -> bool:
        """Take the error of held-out samples, keep the state where it is the least; return whether it has converged."""
        error = self._problem.held_out_rmse()
        if error is None or not np.isfinite(error):
            return False
        if self._best is None or error < self._best[0]:
            self._best = (error, _Kept(self._step, self._method, self._problem.state()))
        waited = self._step - self._best[1].step
        return self._has_open_end and waited > max(_LEAST_PATIENCE, _PATIENCE * self._step)

    @property
    def _settings(self) -> Settings:
        """What was asked for, with all that has been chosen."""
        return replace(self._requested, method=self._method, device=str(self._device))

    def _keep_in_file(self, clock: Clock) -> bool:
        """Write a checkpoint, where one is asked for; return whether the fit goes well."""
        if self._keeper is None:
            return True
        if not self._check_and_keep(clock):
            return False
        self._keeper.keep(self._checkpoint(self._keeper, clock.seconds))
        return True

    def _checkpoint(self, keeper: Checkpointing, seconds: float) -> Checkpoint:
        """Return where the fit stands."""
        error, best = (None, None) if self._best is None else self._best
        return Checkpoint(
            run=keeper.run,
            now=self._stored(_Kept(self._step, self._method, self._problem.state())),
            seconds=seconds,
            losses=np.array(self._losses, dtype=np.float32),
            best=None if best is None else self._stored(best),
            best_error=error,
            command=keeper.command,
            folder=keeper.folder,
        )

    def _stored(self, kept: _Kept) -> KeptState:
        settings = replace(self._settings, method=kept.method)
        arrays = self._problem.stored(kept.state)
        return KeptState(step=kept.step, method=settings.to_dict(), arrays=arrays, drawn=kept.state[-1])

    def _kept_from(self, stored: KeptState) -> _Kept:
        state = self._problem.state_from(stored.arrays, stored.drawn)
        return _Kept(stored.step, _method_of(stored.method), state)

    def _go_on_from(self, found: Checkpoint) -> None:
        """Return to where an earlier process has come to."""
        try:
            kept = self._kept_from(found.now)
            self._problem.restore(kept.state)
            if found.best is not None and found.best_error is not None:
                self._best = found.best_error, self._kept_from(found.best)
        except (ValueError, TypeError, LookupError, RuntimeError) as error:
            raise OutputError(
                f"the checkpoint does not belong to this run ({error}); remove it, and begin anew"
            ) from error
        self._step, self._method, self._kept = kept.step, kept.method, (kept,)
        if self._method.learning_rate is not None:
            self._problem.set_learning_rate(self._method.learning_rate)
        self._losses = found.losses.tolist()

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
            self._method.learning_rate or 0.0,
        )
        self._problem.restore(back.state)
        self._method = back.method
        self._losses = self._losses[: back.step]
        self._step = back.step

    def _draw(self) -> NDArray[np.float32]:
        reference = 0 if self._fitted is None else self._fitted.registration.reference
        return draw(self._representation(), self._canvas, reference, self._burst)


def _method_of(plain: dict[str, Any]) -> TrainedMethod:
    method = Settings.from_dict(plain).method
    if isinstance(method, SplineMethod):
        raise ValueError("a spline is solved, not trained")
    return method
