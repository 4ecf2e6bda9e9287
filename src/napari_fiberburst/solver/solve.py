"""`iterate`, a generator of progress reports, and `reconstruct`, which drains it."""

import logging
import time
from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from napari_fiberburst.burst import Burst
from napari_fiberburst.control import Control
from napari_fiberburst.io import read_burst
from napari_fiberburst.reconstruction import Canvas, Ending, Reconstruction
from napari_fiberburst.settings import Encoding, Fourier, Motion, Settings, choose
from napari_fiberburst.solver.device import find_device
from napari_fiberburst.solver.problem import Problem
from napari_fiberburst.solver.progress import Progress

logger = logging.getLogger(__name__)

# Reports make the host wait for the device, so there are few of them, and more would not be seen.
_SECONDS_BETWEEN_REPORTS = 0.1


def reconstruct(
    frames: Burst | ArrayLike | str | Path,
    *,
    preset: str = "paper",
    motion: str | Motion | None = None,
    encoding: str | Encoding | None = None,
    sigma: float | None = None,
    iterations: int | None = None,
    device: str | None = None,
    seed: int | None = 0,
    on_progress: Callable[[Progress], object] | None = None,
    should_stop: Callable[[], bool] | None = None,
    control: Control | None = None,
    initial: Reconstruction | None = None,
    **more: Any,
) -> Reconstruction:
    """Turn a burst into one clean picture.

    Parameters
    ----------
    frames : Burst, array_like or path
        (T, H, W) or (T, H, W, C); a path is opened by `napari_fiberburst.read_burst`.
    preset : str
        Where settings come from that are None here; "paper" is the published method.
    motion : str or Motion, optional
        "none", "homography", "flow" or "flow_tv", or a settings object.
    encoding : str or Encoding, optional
        "none", "nerf", "fourier", "hash" or "siren", or a settings object.
    sigma : float, optional
        Frequency spread of the Fourier encoding, cycles per half frame; more resolves finer detail, and in the
        end the honeycomb.
    iterations : int, optional
        Optimisation steps.
    device : str, optional
        "auto", "cpu", "cuda", "cuda:1", "mps".
    seed : int
        The same seed gives the same bits on the same CPU with the same number of threads.
    on_progress : callable, optional
        Called with a `Progress` some ten times a second at most, in this thread.
    should_stop : callable, optional
        Asked before every step; where it returns True the run ends with what it has.
    control : Control, optional
        To stop, pause and resume the run from another thread, and change its sigma and learning rate.
    initial : Reconstruction, optional
        Continue from this reconstruction of the same burst for `iterations` more steps. Its settings take the
        preset's place.
    **more
        Any other field of `Settings`, or of the motion or the encoding chosen, by name: ``time_budget=10.0``,
        ``learning_rate=1e-3``, ``features=128``.

    Returns
    -------
    Reconstruction
        Also where the run was stopped early or diverged; `Reconstruction.ending` says so.

    Raises
    ------
    BurstError
        The frames are not a usable burst.
    SettingsError
        A setting is unknown, out of range, or does not apply to the choice made.
    DeviceError
        The device is not on this machine.

    Examples
    --------
    >>> from napari_fiberburst.simulation import simulate
    >>> simulated = simulate("histology", shape=(32, 40), frames=4, pitch=3.0)
    >>> result = reconstruct(simulated.burst, iterations=2)
    >>> result.image.shape
    (32, 40, 3)
    """
    settings = choose(
        preset if initial is None else initial.settings,
        motion=motion,
        encoding=encoding,
        sigma=sigma,
        iterations=iterations,
        device=device,
        seed=seed,
        **more,
    )
    find_device(settings.device)  # before a long read
    burst = as_burst(frames)
    run = iterate(burst, settings, control=control, should_stop=should_stop, initial=initial)
    while True:
        try:
            report = next(run)
        except StopIteration as end:
            result: Reconstruction = end.value
            return result
        if on_progress is not None:
            on_progress(report)


def as_burst(frames: Burst | ArrayLike | str | Path) -> Burst:
    """Return a burst for whatever `reconstruct` takes."""
    if isinstance(frames, Burst):
        return frames
    if isinstance(frames, str | Path):
        return read_burst(frames)
    return Burst(frames)


def iterate(
    burst: Burst,
    settings: Settings,
    *,
    control: Control | None = None,
    should_stop: Callable[[], bool] | None = None,
    initial: Reconstruction | None = None,
) -> Generator[Progress, None, Reconstruction]:
    """Fit a burst and report while it happens; the generator returns the reconstruction.

    Parameters
    ----------
    burst, settings
        What to fit, and how.
    control, should_stop, initial
        As in `reconstruct`.

    Yields
    ------
    Progress
        After the first step, then at most ten times a second, and after the last step.

    Returns
    -------
    Reconstruction
        Of the steps done: a stopped run is still a result.

    Raises
    ------
    SettingsError
        `initial` is not of this burst or of these networks.
    DeviceError
        The device is not on this machine.
    """
    control = control or Control()
    run = _Run(burst, settings, initial)
    while run.step < settings.iterations:
        run.hold_while_paused(control)
        if control.stopped or (should_stop is not None and should_stop()):
            run.ending = "stopped"
            break
        if settings.time_budget is not None and run.seconds >= settings.time_budget:
            run.ending = "time budget"
            break
        run.follow(control)
        run.advance()
        if run.is_report_due():
            if not run.is_healthy():
                break
            yield run.report()
    return run.finish()


class _Run:
    """The bookkeeping of one run: its clock, losses and reports."""

    def __init__(self, burst: Burst, settings: Settings, initial: Reconstruction | None) -> None:
        self._started = time.perf_counter()
        self._burst = burst
        self._settings = settings
        self._initial = initial
        self._device = find_device(settings.device)
        self._problem = Problem(burst, settings, self._device, initial)
        self._losses = torch.zeros(settings.iterations, device=self._device)
        self._looked: tuple[int, ...] = (0,)
        self._sigma: float | None = None
        self._first_done: float | None = None
        self._reported = self._previewed = 0.0
        self.step = 0
        self.ending: Ending = "finished"

    @property
    def seconds(self) -> float:
        """Time spent, pauses left out."""
        return time.perf_counter() - self._started

    def hold_while_paused(self, control: Control) -> None:
        paused_at = time.perf_counter()
        control.wait_while_paused()
        self._started += time.perf_counter() - paused_at

    def follow(self, control: Control) -> None:
        """Take over what a user has changed since the last step."""
        rate, sigma = control.learning_rate, control.sigma
        if rate is not None and rate != self._settings.learning_rate:
            self._problem.set_learning_rate(rate)
            self._settings = replace(self._settings, learning_rate=rate)
        encoding = self._settings.encoding
        if sigma is None or sigma == self._sigma:
            return
        self._sigma = sigma
        if isinstance(encoding, Fourier):
            self._problem.field.scene.set_sigma(sigma)
            self._settings = replace(self._settings, encoding=replace(encoding, sigma=sigma))
        else:
            logger.warning("sigma %g has no effect: encoding %s has no frequency spread", sigma, encoding.name)

    def advance(self) -> None:
        self._losses[self.step] = self._problem.step()
        self.step += 1
        if self._first_done is None:
            self._first_done = self.seconds

    def is_report_due(self) -> bool:
        due = self.seconds - self._reported >= _SECONDS_BETWEEN_REPORTS
        return due or self.step in (1, self._settings.iterations)

    def is_healthy(self) -> bool:
        """Whether all losses since the last look, and all parameters, are numbers; else go back to when they were."""
        finite = torch.isfinite(self._losses[self._looked[-1] : self.step])
        if bool(finite.all()) and self._problem.is_finite():
            self._problem.keep()
            self._looked = (*self._looked[-1:], self.step)
            return True
        self._go_back(newest=bool(finite[:1].all()))
        return False

    def _go_back(self, *, newest: bool) -> None:
        failed = self.step
        self._problem.restore(newest=newest)
        self.step = self._looked[-1 if newest else 0]
        self.ending = "diverged"
        logger.warning(
            "the loss stopped being a number by step %d; going back to step %d; a learning rate lower than %g may help",
            failed,
            self.step,
            self._settings.learning_rate,
        )

    def report(self) -> Progress:
        steps = self.step - 1
        elapsed = self.seconds - (self._first_done or 0.0)
        representation = self._problem.representation()
        every = self._settings.preview_every
        preview = None
        if every is not None and self.seconds - self._previewed >= every:
            preview = self._picture()
            self._previewed = self.seconds
        self._reported = self.seconds
        return Progress(
            step=self.step,
            iterations=self._settings.iterations,
            loss=float(self._losses[self.step - 1]),
            seconds=self.seconds,
            rate=steps / elapsed if steps and elapsed > 0 else 0.0,
            homographies=representation.homographies(),
            preview=preview,
        )

    def finish(self) -> Reconstruction:
        """Return the result of the steps done, or of the last good one."""
        if self.ending != "diverged":
            self.is_healthy()
        image = self._picture()
        if not np.isfinite(image).all():  # no loss was taken after the last step to tell
            self._go_back(newest=False)
            image = self._picture()
        representation = self._problem.representation()
        losses = self._losses[: self.step].cpu().numpy()
        before = self._initial
        return Reconstruction(
            image=image,
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
        )

    @property
    def _canvas(self) -> Canvas:
        return Canvas.over((0, 0, self._burst.shape[2], self._burst.shape[1]))

    def _picture(self) -> NDArray[np.float32]:
        values = self._problem.representation().render(self._canvas.points(), 0)
        return self._burst.in_original_units(values)
