"""The methods: each makes one image of a burst, and says what it is given beside the burst."""

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from benchmarks.cases import Case
from benchmarks.oracle import told_everything
from benchmarks.peers import inpainting, unet
from napari_fiberburst import Progress, Reconstruction, reconstruct
from napari_fiberburst.device import find_device
from napari_fiberburst.errors import FiberBurstError, SettingsError
from napari_fiberburst.pipeline.stages import Stages
from napari_fiberburst.quality import psnr
from napari_fiberburst.settings import SplineMethod
from napari_fiberburst.simulation import SimulatedBurst
from napari_fiberburst.steps import drain

Image = NDArray[np.float32]
# Standard deviations of the Gaussian filters, pixels: 31 to choose from, and one for all bursts.
WIDTHS = np.arange(0.5, 8.1, 0.25)
FIXED_WIDTH = 2.0
PEER_PYTHON = Path(__file__).parents[1] / ".venv-peers" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
_WORKER = Path(__file__).with_name("peers") / "pyfibrebundle.py"


class PeerError(FiberBurstError):
    """A peer cannot be run here; the message says what is missing and how to get it."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much the slow methods may do.

    Attributes
    ----------
    paper_iterations : int
        Steps of the published method; it has 3000.
    inpainting_steps : int
        Steps of the network that inpaints.
    device : str
        Where the published method, the default and the oracle compute.
    """

    paper_iterations: int = 3000
    inpainting_steps: int = inpainting.STEPS
    device: str = "auto"


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """What a method made of a burst.

    Attributes
    ----------
    image : numpy.ndarray
        (H, W, C) on frame 0's pixels, 1 as full scale.
    seconds : float
        What it took, reading and simulating left out.
    homographies : numpy.ndarray or None
        Its motion, where it finds one.
    compression : float or None
        1 - bytes of what stands for the burst / bytes of the burst, where something does.
    curve : list of (float, float)
        Seconds and PSNR of its previews, where it has any.
    notes : tuple of str
        What it says itself of its image.
    quality : str or None
        Its own verdict, where it has one.
    """

    image: Image
    seconds: float
    homographies: NDArray[np.float64] | None = None
    compression: float | None = None
    curve: list[tuple[float, float]] = field(default_factory=list)
    notes: tuple[str, ...] = ()
    quality: str | None = None


@dataclass(frozen=True, kw_only=True)
class Method:
    """A method by its name.

    Attributes
    ----------
    label : str
        As the tables have it.
    given : str
        What it is given beside the burst.
    run : callable
        (case, simulated burst, effort) to outcome.
    depends_on : tuple of str
        The parts of the effort that make a difference to it.
    """

    label: str
    given: str
    run: Callable[[Case, SimulatedBurst, Effort], Outcome]
    depends_on: tuple[str, ...] = ()


def captured(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return frame 0 as it is."""
    return Outcome(image=simulated.burst.frames[0], seconds=0.0)


def gaussian(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return frame 0, filtered by the width whose image is closest to the truth."""
    truth = simulated.truth[0]
    start = time.perf_counter()
    tried = [blurred(simulated.burst.frames[0], width) for width in WIDTHS]
    seconds = (time.perf_counter() - start) / len(WIDTHS)
    best = max(range(len(WIDTHS)), key=lambda number: psnr(tried[number], truth))
    return Outcome(image=tried[best], seconds=seconds, notes=(f"width {WIDTHS[best]:g} px",))


def gaussian_fixed(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return frame 0, filtered by the same width in every case."""
    start = time.perf_counter()
    image = blurred(simulated.burst.frames[0], FIXED_WIDTH)
    return Outcome(image=image, seconds=time.perf_counter() - start)


def registered_mean(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return the mean of the frames, each moved onto frame 0 by our registration; no bundle model beyond that."""
    start = time.perf_counter()
    fitted = drain(Stages(simulated.burst, SplineMethod(), find_device(effort.device)).align())
    homographies = fitted.registration.reference_from_frame
    image = mean_over(simulated.burst.frames, homographies)
    return Outcome(image=image, seconds=time.perf_counter() - start, homographies=homographies)


def fibrebundle_single(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return what PyFibreBundle interpolates between the cores of frame 0."""
    return _fibrebundle("single", case, simulated)


def fibrebundle_super(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return PyFibreBundle's super-resolution of all frames."""
    return _fibrebundle("super", case, simulated)


def supervised(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return what the trained network makes of frame 0."""
    network = unet.load()
    start = time.perf_counter()
    image = unet.clean(simulated.burst.frames[0], network)
    return Outcome(image=image, seconds=time.perf_counter() - start)


def inpainted(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return what a coordinate network draws between the cores of frame 0."""
    start = time.perf_counter()
    image = inpainting.inpaint(simulated.burst.frames[0], simulated.bundle, steps=effort.inpainting_steps)
    return Outcome(image=image, seconds=time.perf_counter() - start)


def paper(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return the published method's image; its sigma is to the bundle as the published one was to its bundle."""
    return reconstructed(
        simulated, preset="paper", sigma=case.sigma, iterations=effort.paper_iterations, device=effort.device
    )


def default(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return what `reconstruct` makes of the burst."""
    return reconstructed(simulated, device=effort.device, fill=True)


def oracle(case: Case, simulated: SimulatedBurst, effort: Effort) -> Outcome:
    """Return what our solver makes of the burst when it is told everything but the scene."""
    start = time.perf_counter()
    image = told_everything(case, simulated, effort.device)
    return Outcome(
        image=_in_full_scale(simulated, image),
        seconds=time.perf_counter() - start,
        homographies=simulated.homographies,
    )


METHODS: Mapping[str, Method] = {
    "captured": Method(label="captured frame", given="", run=captured),
    "gaussian": Method(label="Gaussian filter, best width", given="the truth, to choose its width", run=gaussian),
    "gaussian-fixed": Method(label="Gaussian filter, 2 px", given="", run=gaussian_fixed),
    "mean": Method(
        label="mean after registration", given="our registration", run=registered_mean, depends_on=("device",)
    ),
    "pyfibrebundle": Method(
        label="PyFibreBundle, one frame", given="true layout and transmission", run=fibrebundle_single
    ),
    "pyfibrebundle-sr": Method(
        label="PyFibreBundle, super-resolution", given="true layout and transmission", run=fibrebundle_super
    ),
    "unet": Method(label="supervised U-Net", given="1200 training pairs", run=supervised),
    "inpainting": Method(
        label="INR inpainting", given="true layout and transmission", run=inpainted, depends_on=("inpainting_steps",)
    ),
    "paper": Method(
        label="published method", given="sigma by the true pitch", run=paper, depends_on=("paper_iterations", "device")
    ),
    "default": Method(label="napari-fiberburst", given="", run=default, depends_on=("device",)),
    "oracle": Method(label="oracle", given="the truth of all but the scene", run=oracle, depends_on=("device",)),
}


def find(names: list[str] | None) -> tuple[str, ...]:
    """Return the methods of these names, all where there are no names.

    Raises
    ------
    SettingsError
        There is no such method.
    """
    for name in names or []:
        if name not in METHODS:
            raise SettingsError(f"unknown method {name!r}; known: {', '.join(METHODS)}")
    return tuple(names or METHODS)


def reconstructed(simulated: SimulatedBurst, **choices: Any) -> Outcome:
    """Return what `reconstruct` makes of a burst, and how its previews went."""
    curve: list[tuple[float, float]] = []
    truth = simulated.truth[0]

    def watch(report: Progress) -> None:
        if report.preview is not None and report.preview.shape == truth.shape:
            seen = np.nan_to_num(_in_full_scale(simulated, report.preview), nan=float(np.nanmean(report.preview)))
            curve.append((report.seconds, psnr(seen, truth)))

    start = time.perf_counter()
    result = reconstruct(simulated.burst, on_progress=watch, preview_every=0.5, **choices)
    return _outcome(simulated, result, time.perf_counter() - start, curve)


def blurred(frame: Image, width: float) -> Image:
    """Return a frame (H, W, C) after a Gaussian filter."""
    filtered: Image = gaussian_filter(frame, (width, width, 0))
    return filtered


def mean_over(frames: Image, homographies: NDArray[np.float64]) -> Image:
    """Return the mean of the frames on frame 0's pixels, cubic splines between pixels; frame 0 where no other saw."""
    rows, columns = np.indices(frames.shape[1:3], dtype=np.float64)
    points = np.stack([columns, rows, np.ones_like(rows)])
    total, count = np.zeros(frames.shape[1:]), np.zeros(frames.shape[1:3])
    for frame, matrix in zip(frames, homographies, strict=True):
        if not np.isfinite(matrix).all():
            continue
        x, y, depth = np.einsum("ij,jhw->ihw", np.linalg.inv(matrix), points)
        bands = [
            map_coordinates(band, (y / depth, x / depth), order=3, cval=np.nan) for band in np.moveaxis(frame, -1, 0)
        ]
        moved = np.stack(bands, axis=-1)
        seen = np.isfinite(moved).all(axis=-1)
        total[seen] += moved[seen]
        count += seen
    mean: Image = np.where(count[..., None] > 0, total / np.maximum(count, 1)[..., None], frames[0]).astype(np.float32)
    return mean


def fibrebundle(method: str, **inputs: Any) -> tuple[Image, float]:
    """Run PyFibreBundle; see `benchmarks/peers/pyfibrebundle.py` for its inputs.

    Raises
    ------
    PeerError
        It is not installed, or it failed.
    """
    if not PEER_PYTHON.exists():
        raise PeerError("not installed: make peers")
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder, "given.npz"), Path(folder, "made.npz")
        np.savez(given, **inputs)
        ended = subprocess.run([PEER_PYTHON, _WORKER, method, given, made], capture_output=True, text=True)
        if ended.returncode:
            said = ended.stderr.strip().splitlines() or [f"exit status {ended.returncode}"]
            raise PeerError(f"failed: {said[-1]}")
        with np.load(made) as found:
            return found["image"], float(found["seconds"])


def _fibrebundle(method: str, case: Case, simulated: SimulatedBurst) -> Outcome:
    image, seconds = fibrebundle(
        method,
        frames=simulated.burst.frames,
        bundle=simulated.transmission,
        centres=simulated.bundle.centres,
        pitch=case.pitch,
        x=0.0,
        y=0.0,
        size=case.side,
        grid=case.side,
    )
    return Outcome(image=image, seconds=seconds)


def _outcome(
    simulated: SimulatedBurst, result: Reconstruction, seconds: float, curve: list[tuple[float, float]]
) -> Outcome:
    return Outcome(
        image=_in_full_scale(simulated, result.image),
        seconds=seconds,
        homographies=result.homographies,
        compression=result.compression,
        curve=curve,
        notes=result.notes,
        quality=result.quality,
    )


def _in_full_scale(simulated: SimulatedBurst, image: NDArray[np.floating]) -> Image:
    burst = simulated.burst
    scaled: Image = ((image - burst.black_level) / (burst.white_level - burst.black_level)).astype(np.float32)
    return scaled if scaled.ndim == 3 else scaled[..., None]
