"""`iterate`, a generator of progress reports, and `reconstruct`, which drains it."""

from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
from typing import Any, assert_never

import torch
from numpy.typing import ArrayLike

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.control import Control
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.device import find_device, is_out_of_memory, settle_threads
from napari_fiberburst.errors import MemoryLimitError, SettingsError
from napari_fiberburst.io import read_burst
from napari_fiberburst.memory import MemoryLimit, estimate_memory, in_words
from napari_fiberburst.pipeline.checkpoint import SECONDS_BETWEEN, Checkpointing, check_kept, told_by
from napari_fiberburst.pipeline.network import NetworkFit, published
from napari_fiberburst.pipeline.spline import SplineFit
from napari_fiberburst.pipeline.supervise import Fit, supervise
from napari_fiberburst.results.progress import Progress
from napari_fiberburst.results.reconstruction import Reconstruction
from napari_fiberburst.settings import (
    Encoding,
    Motion,
    NetworkMethod,
    PublishedMethod,
    Settings,
    SplineMethod,
    choose,
)


def reconstruct(
    frames: Burst | ArrayLike | str | Path,
    *,
    preset: str | Settings = "auto",
    motion: str | Motion | None = None,
    encoding: str | Encoding | None = None,
    sigma: float | None = None,
    iterations: int | None = None,
    device: str | None = None,
    seed: int | None = 0,
    bundle: Bundle | ArrayLike | str | Path | None = None,
    calibration: ArrayLike | str | Path | None = None,
    on_progress: Callable[[Progress], object] | None = None,
    should_stop: Callable[[], bool] | None = None,
    time_budget: float | None = None,
    control: Control | None = None,
    initial: Reconstruction | None = None,
    checkpoint: str | Path | Checkpointing | None = None,
    checkpoint_every: float = SECONDS_BETWEEN,
    **more: Any,
) -> Reconstruction:
    """Turn a burst into one clean image.

    Parameters
    ----------
    frames : Burst, array_like or path
        (T, H, W) or (T, H, W, C); a path is opened by `napari_fiberburst.read_burst`.
    preset : str or Settings
        Where settings come from that are None here: "auto" calibrates the bundle from the burst, registers the frames
        and solves the scene; "paper" is the published method; or settings, such as those of another result.
    motion : str or Motion, optional
        "auto", "translation", "similarity", "affine", "homography", "deformable" or "none", or of a network "flow" or
        "flow_tv"; or a settings object.
    encoding : str or Encoding, optional
        "spline", or a network: "none", "nerf", "fourier", "hash", "siren"; or a settings object.
    sigma : float, optional
        Frequency spread of the Fourier encoding, cycles per half frame; more resolves finer detail, and in the
        end noise or honeycomb.
    iterations : int, optional
        Optimisation steps of a network; rounds of joint refinement of the spline.
    device : str, optional
        "auto" (CUDA where it is), "cpu", "cuda", "cuda:1"; "mps", an Apple GPU, for the published method alone.
    seed : int
        The same seed gives the same bits on the same CPU, whatever the number of threads; a network's depend on it.
    bundle : Bundle, array_like or path, optional
        The bundle, where it is known: a `Bundle`, a file that one was saved to, or an image of the bundle with nothing
        but even light before it. It is never needed, but where it is given, one frame is a burst. It may sit up to 5
        pixels or 2 degrees away from where it was measured; `Reconstruction.notes` then says by how much.
    calibration : array_like or path, optional
        Short for ``bundle=Bundle.from_image(calibration)``.
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
    checkpoint : str or Path, optional
        A file ending in ``.checkpoint``, in which a fit of networks is kept while it runs. Where the file is there, the
        run goes on from it, to the same bits on the same CPU: give a killed run once more. Remove it when the
        result is saved.
    checkpoint_every : float
        Seconds from one to the next.
    **more
        Any other parameter of `Settings`, or of the method, motion or encoding chosen, by name. Of the spline among
        others ``smoothness``, ``upsample`` (pixels of the image to one of a frame), ``canvas`` ("frame", or "union" of
        all that frames saw), ``fill`` (also where no core has looked), ``flatten`` ("motion", "frame" or "none"),
        ``leave_out`` (numbers of frames); of networks ``learning_rate``, ``features``; of all ``memory`` ("4 GB"),
        ``preview_every`` (seconds). The page *Settings* of the documentation has all of them.

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
    MemoryLimitError
        The run takes more memory than ``memory="4 GB"`` allows, or than there is.
    DeviceError
        The device is not on this machine.
    OutputError
        The checkpoint is of another run, is damaged, or cannot be written.

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
    if bundle is not None and calibration is not None:
        raise SettingsError("calibration is short for bundle=Bundle.from_image(calibration); give one of the two")
    _device_of(settings)  # before a long read
    known = bundle if bundle is not None else calibration
    _check_bundle(settings, known)
    if checkpoint is not None:
        check_kept(settings)
        if not isinstance(checkpoint, Checkpointing):
            checkpoint = Checkpointing(checkpoint, checkpoint_every)
    run = iterate(
        as_burst(frames),
        settings,
        control=control,
        should_stop=should_stop,
        initial=initial,
        bundle=None if known is None else as_bundle(known),
        checkpointing=checkpoint,
    )
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


def as_bundle(bundle: Bundle | ArrayLike | str | Path) -> Bundle:
    """Return a bundle for whatever `reconstruct` takes: a bundle, its file, or an image of it in even light."""
    if isinstance(bundle, Bundle):
        return bundle
    if isinstance(bundle, str | Path) and Bundle.is_file(bundle):
        return Bundle.load(bundle)
    return Bundle.from_image(bundle)


def iterate(
    burst: Burst,
    settings: Settings,
    *,
    control: Control | None = None,
    should_stop: Callable[[], bool] | None = None,
    initial: Reconstruction | None = None,
    bundle: Bundle | None = None,
    checkpointing: Checkpointing | None = None,
) -> Generator[Progress, None, Reconstruction]:
    """Fit a burst and report while it happens; the generator returns the reconstruction.

    Parameters
    ----------
    burst, settings
        What to fit, and how. A time budget runs from the first step on, while reports are taken too, and leaves
        time for at least one step.
    control, should_stop, initial, bundle
        As in `reconstruct`.
    checkpointing : Checkpointing, optional
        Where a fit of networks is kept, and goes on from.

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
    OutputError
        The checkpoint is of another run, is damaged, or cannot be written.
    """
    control = Control() if control is None else control
    if not isinstance(control, Control):
        raise SettingsError(f"control must be a napari_fiberburst.Control; got {control!r}")
    _check_bundle(settings, bundle)
    if isinstance(settings.method, SplineMethod) and initial is not None:
        raise SettingsError("a spline is solved, so there is nothing to continue; run it anew, or take a network")
    device = _device_of(settings)
    settle_threads()
    if checkpointing is not None:
        check_kept(settings)
        checkpointing.begin(told_by(burst, settings, bundle, initial))
    fit: Fit
    match settings.method:
        case SplineMethod() as method:
            fit = SplineFit(burst, settings, method, device, bundle, MemoryLimit(burst.shape, settings))
        case NetworkMethod() as method:
            fit = NetworkFit(burst, settings, method, device, control, initial, bundle, checkpointing)
        case PublishedMethod() as method:
            fit = published(burst, settings, method, device, control, initial, checkpointing)
        case _:
            assert_never(settings.method)
    try:
        return (yield from supervise(fit, settings, control, should_stop))
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        needed = in_words(estimate_memory(burst.shape, settings))
        raise MemoryLimitError(
            f"memory ran out ({error}); such a run takes about {needed} beside the burst: crop the burst, take fewer "
            "frames, lower the upsampling, or let other programs end"
        ) from error


def _device_of(settings: Settings) -> torch.device:
    return find_device(settings.device, needs_double=not isinstance(settings.method, PublishedMethod))


def _check_bundle(settings: Settings, bundle: object) -> None:
    if isinstance(settings.method, PublishedMethod) and bundle is not None:
        raise SettingsError("the published method has no model of the bundle; leave the bundle out, or take auto")


def _continued(initial: Reconstruction, seed: int | None) -> tuple[Settings, None]:
    """Return the settings to go on with; the seed is among them, because it has drawn the frequencies."""
    if not isinstance(initial, Reconstruction):
        raise SettingsError(
            f"initial must be a Reconstruction, such as napari_fiberburst.load returns; got {initial!r}"
        )
    if seed not in (None, 0, initial.settings.seed):
        raise SettingsError(
            f"a continued run keeps its seed, {initial.settings.seed}; got {seed}; leave it out, or start anew"
        )
    # How long to run, where, and what to show belong to the run, not to what it has made.
    asked: dict[str, Any] = {"iterations": initial.requested.method.iterations}
    method = replace(initial.settings.method, **asked)
    device = initial.requested.device
    return replace(initial.settings, method=method, device=device, time_budget=None, preview_every=None), None
