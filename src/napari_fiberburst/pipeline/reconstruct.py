"""`iterate`, a generator of progress reports, and `reconstruct`, which drains it."""

from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from napari_fiberburst.control import Control
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.device import find_device
from napari_fiberburst.errors import BurstError, SettingsError
from napari_fiberburst.io import read_burst
from napari_fiberburst.io.folder import read_picture
from napari_fiberburst.pipeline.network import Run
from napari_fiberburst.pipeline.spline import SelfCalibrated
from napari_fiberburst.results.progress import Progress
from napari_fiberburst.results.reconstruction import Reconstruction
from napari_fiberburst.settings import Encoding, Fourier, Motion, Settings, Spline, choose

# A longer last axis of a calibration image is its width.
_MOST_CHANNELS = 15
# Spread of the Fourier features' frequencies, cycles per pitch: detail between cores is resolved, noise hardly.
_PERIODS_PER_PITCH = 0.3


def reconstruct(
    frames: Burst | ArrayLike | str | Path,
    *,
    preset: str = "auto",
    motion: str | Motion | None = None,
    encoding: str | Encoding | None = None,
    sigma: float | None = None,
    iterations: int | None = None,
    device: str | None = None,
    seed: int | None = 0,
    calibration: ArrayLike | str | Path | None = None,
    on_progress: Callable[[Progress], object] | None = None,
    should_stop: Callable[[], bool] | None = None,
    time_budget: float | None = None,
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
        Where settings come from that are None here: "auto" calibrates the bundle from the burst, registers the frames
        and solves the scene; "paper" is the published method.
    motion : str or Motion, optional
        "translation", "similarity", "affine", "homography", "none", "flow" or "flow_tv", or a settings object.
    encoding : str or Encoding, optional
        "spline", or a network: "none", "nerf", "fourier", "hash", "siren"; or a settings object.
    sigma : float, optional
        Frequency spread of the Fourier encoding, cycles per half frame; more resolves finer detail, and in the
        end noise or honeycomb.
    iterations : int, optional
        Optimisation steps of a network; rounds of joint refinement of the spline.
    device : str, optional
        "auto", "cpu", "cuda", "cuda:1", "mps".
    seed : int
        The same seed gives the same bits on the same CPU with the same number of threads.
    calibration : array_like or path, optional
        Picture of the bundle with nothing but even light before it, (H, W) or (H, W, C) like a frame, with the same
        black and white level; several of them, (T, H, W) or (T, H, W, C), are averaged. Its brightness is used; gains
        of the channels are found from the burst all the same. Never needed.
    on_progress : callable, optional
        Called with a `Progress` some ten times a second at most, in this thread.
    should_stop : callable, optional
        Asked before every step, and while paused; where it returns True the run ends with what it has.
    time_budget : float, optional
        Seconds, from the first step on, after which the run ends with what it has.
    control : Control, optional
        To stop, pause and resume the run from another thread, and change its sigma and learning rate.
    initial : Reconstruction, optional
        Continue from this reconstruction of the same burst for `iterations` more steps. Its settings, the seed
        among them, take the preset's place, but for its time budget and previews. In one process the run goes on
        exactly as if it had not been divided; one that was loaded from a file goes on with fresh samples, but
        Adam's moments start anew.
    **more
        Any other field of `Settings`, or of the motion or the encoding chosen, by name: ``learning_rate=1e-3``,
        ``features=128``, ``preview_every=1.0``.

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
    settings = choose(preset)
    if initial is not None:
        settings, seed = _continued(initial, seed)
    settings = choose(
        settings,
        motion=motion,
        encoding=encoding,
        sigma=sigma,
        iterations=iterations,
        device=device,
        seed=seed,
        time_budget=time_budget,
        **more,
    )
    for name, called in (("on_progress", on_progress), ("should_stop", should_stop)):
        if called is not None and not callable(called):
            raise SettingsError(f"{name} must be a function; got {called!r}")
    find_device(settings.device)  # before a long read
    burst = as_burst(frames)
    run = iterate(burst, settings, control=control, should_stop=should_stop, initial=initial, calibration=calibration)
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


def as_calibration(image: ArrayLike | str | Path | None, burst: Burst) -> torch.Tensor | None:
    """Return a picture of the bundle in even light as (H, W, C) in [0, 1], on the burst's levels and crop.

    Raises
    ------
    BurstError
        It cannot be read, or its size is not that of the burst's frames.
    """
    if image is None:
        return None
    pixels = np.asarray(read_picture(image) if isinstance(image, str | Path) else image, dtype=np.float32)
    if pixels.ndim == 4 or (pixels.ndim == 3 and pixels.shape[2] > _MOST_CHANNELS):
        pixels = pixels.mean(axis=0)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    row, column = burst.origin
    if pixels.shape[:2] != burst.shape[1:3]:
        pixels = pixels[row : row + burst.shape[1], column : column + burst.shape[2]]
    if pixels.shape[:2] != burst.shape[1:3] or not np.isfinite(pixels).all():
        raise BurstError(
            f"a calibration image must be finite and have the size of a frame, {burst.shape[1]} x {burst.shape[2]}; "
            f"got {np.shape(image) if not isinstance(image, str | Path) else image}"
        )
    return torch.from_numpy((pixels - burst.black_level) / (burst.white_level - burst.black_level)).float()


def iterate(
    burst: Burst,
    settings: Settings,
    *,
    control: Control | None = None,
    should_stop: Callable[[], bool] | None = None,
    initial: Reconstruction | None = None,
    calibration: ArrayLike | str | Path | None = None,
) -> Generator[Progress, None, Reconstruction]:
    """Fit a burst and report while it happens; the generator returns the reconstruction.

    Parameters
    ----------
    burst, settings
        What to fit, and how. A time budget runs from the first step on, while reports are taken too, and leaves
        time for at least one step.
    control, should_stop, initial, calibration
        As in `reconstruct`.

    Yields
    ------
    Progress
        After the first step, then at most ten times a second, and at the end, however it came, with a preview
        where previews are asked for. None where the run was stopped before its first step.

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
    control = Control() if control is None else control
    if not isinstance(control, Control):
        raise SettingsError(f"control must be a napari_fiberburst.Control; got {control!r}")
    if settings.is_published:
        if calibration is not None:
            raise SettingsError("the published method has no use for a calibration image; leave it out, or take auto")
        return (yield from _train(Run(burst, settings, initial), control, should_stop))
    fit = SelfCalibrated(burst, settings, as_calibration(calibration, burst))
    if isinstance(settings.encoding, Spline):
        if initial is not None:
            raise SettingsError("a spline is solved, so there is nothing to continue; run it anew, or take a network")
        return (yield from fit.run(control, should_stop))
    yield from fit.prepare(control, should_stop)
    settings = _following_pitch(settings, fit)
    return (yield from _train(Run(burst, settings, initial, fit), control, should_stop))


def _train(
    run: Run, control: Control, should_stop: Callable[[], bool] | None
) -> Generator[Progress, None, Reconstruction]:
    """Take a network's steps."""
    while run.step < run.iterations:
        run.hold_while_paused(control, should_stop)
        if control.stopped or (should_stop is not None and should_stop()):
            run.ending = "stopped"
            break
        if run.is_out_of_time():
            run.ending = "time budget"
            break
        run.follow(control)
        run.advance()
        if run.is_report_due():
            if not run.is_healthy():
                break
            converged = run.has_converged()
            yield run.report()
            if converged:
                break
    run.finish()
    if run.step > 0:
        yield run.report(last=True)
    return run.result()


def _following_pitch(settings: Settings, fit: SelfCalibrated) -> Settings:
    """Return the settings with the frequency spread that suits the bundle, where it is left open."""
    encoding = settings.encoding
    if not isinstance(encoding, Fourier) or encoding.sigma is not None:
        return settings
    sigma = _PERIODS_PER_PITCH * max(fit.alignment.shape) / 2 / fit.alignment.pitch
    return replace(settings, encoding=replace(encoding, sigma=sigma))


def _continued(initial: Reconstruction, seed: int | None) -> tuple[Settings, None]:
    """Return the settings to go on with; the seed is among them, for it has drawn the frequencies."""
    if not isinstance(initial, Reconstruction):
        raise SettingsError(
            f"initial must be a Reconstruction, such as napari_fiberburst.load returns; got {initial!r}"
        )
    if seed not in (None, 0, initial.settings.seed):
        raise SettingsError(
            f"a continued run keeps its seed, {initial.settings.seed}; got {seed}; leave it out, or start anew"
        )
    # How long to run and what to show belong to the run, not to what it has made.
    return replace(initial.settings, time_budget=None, preview_every=None), None
