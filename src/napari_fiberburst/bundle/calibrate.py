"""Step 1: calibrate the bundle, from the burst alone.

The object moves and the bundle does not, so the mean of the frames, divided by itself blurred over a few cores, shows
the bundle: its pitch, its cores, and how much light each pixel passes. What the mean still shows of the object is told
apart after the frames have been registered (`napari_fiberburst.motion.joint`, `remeasure`).
"""

from collections.abc import Generator
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from napari_fiberburst.bundle.black import black_between_cores
from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.cores import brightest, find_cores, find_gaps, footprint_radius
from napari_fiberburst.bundle.field import find_field, find_marks, widened, without_rim
from napari_fiberburst.bundle.lattice import REACH, nearest_core
from napari_fiberburst.bundle.pitch import find_pitch
from napari_fiberburst.bundle.samples import SATURATED, only_exposed, sample_cores
from napari_fiberburst.data.burst import Acquisition, Burst
from napari_fiberburst.device import find_device
from napari_fiberburst.operators.filters import blur, local_mean
from napari_fiberburst.steps import drain

# In pitches: over this much the mean frame is blurred to tell bundle from object. One pitch takes gain for object: it
# leaves faint clouds that hold a low-contrast object still; many pitches leave the object in the calibration.
_ENVELOPE = 3.0
# Pixels. Below this pitch cores cannot be told apart, and pixels stand for themselves.
LEAST_RESOLVED_PITCH = 2.9
# Pixels to a side of the blocks that stand for cores where there are none.
_BLOCK = 4
# Fewer blobs than this are no bundle.
_LEAST_CORES = 20
# Part of the light of a well-lit place below which a place lies outside the bundle.
_DARK = 0.04
# The black level is this quantile of the mean frame: the space between cores, or outside the field.
_BLACK_QUANTILE = 0.002
# In even light, the space between cores is black where it has less than this part of a bright place's light.
_DARK_BESIDE = 0.25
# Pixels: over this much what lies under marks is filled in, for cores to be found beside them.
_FILLED_FROM = 1.0
# In pitches: a core's footprint before its profile has been measured.
_USUAL_RADIUS = 0.36
# The mean of few frames still shows an object of much contrast (standard deviation of a core's light over the frames,
# relative to its mean), and a gain taken from it would hide that object: all cores then start as equal. In low contrast
# the cores' own differences would hold the object still.
_FEW_FRAMES, _MUCH_CONTRAST = 8, 0.022


def calibrate(burst: Burst, *, device: str = "auto") -> Bundle:
    """Calibrate the bundle from the mean of a burst's frames.

    Parameters
    ----------
    burst : Burst
        Frames of a moving object. From a still one, or from a single frame, the object is taken for the bundle's gains.
    device : str
        Where to compute.

    Returns
    -------
    Bundle
        Its `pattern` is "none" where the frames show no bundle.

    Examples
    --------
    >>> from napari_fiberburst.simulation import simulate
    >>> calibrate(simulate("cat", shape=(96, 90), frames=6, pitch=6.0).burst).is_resolved
    True
    """
    frames = torch.from_numpy(burst.frames).to(find_device(device))
    grey = frames.mean(dim=3)
    bundle = drain(calibrating(grey, burst, find_marks(only_exposed(grey))))
    return with_even_gains(bundle) if shows_the_object(bundle, grey, burst) else bundle


def calibrating(grey: Tensor, acquisition: Acquisition, marks: Tensor) -> Generator[str, None, Bundle]:
    """Calibrate the bundle from the mean of grey frames (T, H, W) in [0, 1] with marks (H, W) burned into them.

    Yields the name of each step that is done.
    """
    origin = {"source": "burst", "bursts": 0, "frames": len(grey)}
    grey = only_exposed(grey)
    mean = grey.mean(dim=0)
    field = find_field(grey, find_pitch(mean))
    mean = torch.where(marks, local_mean(mean, _FILLED_FROM, (~marks).to(mean)), mean)
    bundle = with_saturated((yield from calibrating_mean(mean, acquisition, origin, field, frames=grey)), grey)
    return bundle.masked(marks.cpu().numpy())


def shows_the_object(bundle: Bundle, grey: Tensor, acquisition: Acquisition) -> bool:
    """Whether gains that were taken from the mean of grey frames (T, H, W) are likely to hold the object as well."""
    grey = only_exposed(grey)
    if not bundle.is_resolved or bundle.gains_known or not 1 < len(grey) <= _FEW_FRAMES:
        return False
    light = sample_cores(grey[..., None], bundle, acquisition).values[..., 0]
    return float((light.std(dim=0) / light.mean(dim=0).abs().clamp_min(1e-6)).median()) > _MUCH_CONTRAST


def calibrating_mean(
    mean: Tensor,
    acquisition: Acquisition,
    provenance: dict[str, Any],
    field: Tensor | None = None,
    *,
    frames: Tensor | None = None,
    even_light: bool = False,
) -> Generator[str, None, Bundle]:
    """Calibrate the bundle from one image of it (H, W) in [0, 1]; yields the name of each step that is done.

    In even light the image is the transmission; otherwise its slow changes are divided out of it. Outside the field
    (H, W), by default all of the image, there is no bundle. Frames (T, H, W) of which it is the mean tell the black
    level better than it does.
    """
    field = torch.ones_like(mean, dtype=torch.bool) if field is None else field
    told = {**provenance, "date": datetime.now(UTC).strftime("%Y-%m-%d"), "version": _version()}
    gain_weight = 1.0 if even_light else 0.0
    pitch = find_pitch(mean, field)
    yield "pitch found"
    inner = without_rim(field)
    plain = _blocks(torch.ones_like(mean), inner, acquisition, pattern="none", black=0.0, provenance=told)
    if pitch is None:
        return plain
    black = _black_level(mean, pitch, field, frames)
    # The outermost cores shine beyond the field.
    reached = widened(field, pitch)
    light = (mean - black).clamp_min(0) * reached
    envelope = local_mean(light, _ENVELOPE * pitch)
    outline = (envelope > _DARK * torch.quantile(thinned(envelope), 0.95)) & reached
    envelope = local_mean(light, _ENVELOPE * pitch, outline.to(light)).clamp_min(1e-6)
    flat = torch.where(outline, light / envelope, torch.zeros_like(light))
    passed = light if even_light else flat
    if pitch < LEAST_RESOLVED_PITCH:
        return _blocks(
            passed, inner, acquisition, pattern="unresolved", black=black, gain_weight=gain_weight, provenance=told
        )
    centres = find_cores(flat, pitch, outline)
    yield "cores found"
    if len(centres) < _LEAST_CORES:
        return plain
    # Points are single precision, as all that is computed from them.
    centres = centres.astype(np.float32).astype(np.float64)
    labels = nearest_core(centres.astype(np.float32), outline.cpu().numpy(), REACH * pitch)
    filled = (blur(torch.from_numpy(labels < len(centres)).to(mean), pitch) > 0.45).cpu().numpy()
    count = len(centres)
    draft = Bundle(
        pattern="cores",
        pitch=pitch,
        radius=_USUAL_RADIUS * pitch,
        centres=centres,
        labels=labels.astype(np.int32),
        transmission=np.zeros(labels.shape, np.float32),
        gains=np.ones((count, 1), np.float32),
        gain_weights=np.full(count, gain_weight, np.float32),
        offsets=np.zeros((count, 1), np.float32),
        black=in_units(black, acquisition),
        dead=find_gaps(centres, filled, pitch),
        saturated=np.zeros(count, dtype=bool),
        outline=filled | (labels < count),
        provenance=told,
    )
    return with_transmission(draft, passed)


def with_transmission(bundle: Bundle, transmission: Tensor) -> Bundle:
    """Return the bundle with another transmission (H, W), brought to its scale: 1 where a bright core is brightest."""
    labels = torch.from_numpy(bundle.labels).to(transmission.device).long()
    own = labels < len(bundle.centres)
    transmission = torch.where(own, transmission.clamp_min(0), torch.zeros_like(transmission))
    transmission = transmission / bright_level(transmission[own])
    radius = bundle.radius
    if bundle.is_resolved:
        centres = torch.from_numpy(bundle.centres).to(transmission)
        radius = footprint_radius(transmission, labels, centres, bundle.pitch)
    return replace(bundle, transmission=transmission.cpu().numpy(), radius=radius)


def with_saturated(bundle: Bundle, frames: Tensor) -> Bundle:
    """Return the bundle with those cores marked that are too bright for the camera in most frames (T, H, W).

    In most of their light: the dark rim that belongs to a core's cell does not saturate.
    """
    own = bundle.labels < len(bundle.centres)
    labels, mass = bundle.labels[own], bundle.transmission[own].astype(np.float64) ** 2
    often = (frames >= SATURATED).float().mean(dim=0).cpu().numpy()[own]
    total, too_bright = (np.bincount(labels, part, len(bundle.centres)) for part in (mass, mass * often))
    return replace(bundle, saturated=too_bright > 0.5 * np.maximum(total, 1e-12))


def with_even_gains(bundle: Bundle) -> Bundle:
    """Return the bundle with all cores equally bright, where gain and object look the same and no gain is known."""
    if not bundle.is_resolved or bundle.gains_known:
        return bundle
    transmission, labels = torch.from_numpy(bundle.transmission), torch.from_numpy(bundle.labels).long()
    own = labels < len(bundle.centres)
    peaks = brightest(transmission, labels, len(bundle.centres), bundle.pitch)
    even = torch.zeros_like(transmission)
    even[own] = transmission[own] / peaks[labels[own]]
    return with_transmission(bundle, even)


def remark(bundle: Bundle) -> str:
    """Return what a user should know of the bundle; nothing where all is as usual."""
    return {
        "cores": "",
        "unresolved": "the cores are too close to be told apart; pixels stand for themselves",
        "none": "no bundle is seen in the frames; they are taken as plain images",
    }[bundle.pattern]


def plain_frames(shape: tuple[int, int], acquisition: Acquisition) -> Bundle:
    """Return what stands for the bundle before it has been calibrated: every pixel passes all light."""
    even = torch.ones(shape)
    return _blocks(even, even > 0, acquisition, pattern="none", black=0.0, provenance={"source": "none"})


def in_units(value: float, acquisition: Acquisition) -> float:
    """Return an intensity of [0, 1] in the recording's units."""
    return acquisition.black_level + value * (acquisition.white_level - acquisition.black_level)


def bright_level(values: Tensor) -> Tensor:
    """Return what a bright pixel shows: the 97th percentile, so that a few outliers set no scale."""
    return torch.quantile(thinned(values), 0.97).clamp_min(1e-9)


def thinned(values: Tensor) -> Tensor:
    """Return some of the values, evenly taken: torch.quantile takes only so many."""
    flat = values.reshape(-1)
    return flat[:: max(1, len(flat) // 100_000)]


def _version() -> str:
    try:
        return version("napari-fiberburst")
    except PackageNotFoundError:  # run from its sources
        return "unknown"


def _black_level(mean: Tensor, pitch: float, field: Tensor, frames: Tensor | None) -> float:
    """Return the intensity without light in a mean frame (H, W) of frames (T, H, W), full scale 1.

    A bundle is black about its field. One that fills the frame may be black between its cores, or show no black at all.
    Where that cannot be told, as of the faintest, the black level of the recording has to do; in an image in even
    light, what is between the cores is black where it is dark beside them.
    """
    darkest = float(torch.quantile(thinned(mean), _BLACK_QUANTILE))
    if not bool(field.all()) or pitch < LEAST_RESOLVED_PITCH:
        return darkest
    if frames is None:
        return darkest if darkest < _DARK_BESIDE * float(torch.quantile(thinned(mean), 0.95)) else 0.0
    told = black_between_cores(frames, pitch)
    return 0.0 if told is None else min(max(told, 0.0), darkest)


def _blocks(
    transmission: Tensor,
    field: Tensor,
    acquisition: Acquisition,
    *,
    pattern: Literal["unresolved", "none"],
    black: float,
    provenance: dict[str, Any],
    gain_weight: float = 0.0,
) -> Bundle:
    """Return a bundle whose cores are square blocks of the field's pixels."""
    height, width = transmission.shape
    outline = field.cpu().numpy()
    columns = -(-width // _BLOCK)
    y, x = np.nonzero(outline)
    shown, labels = np.unique((y // _BLOCK) * columns + x // _BLOCK, return_inverse=True)
    count = len(shown)
    size = np.bincount(labels, minlength=count)
    # Single precision, as all that is computed from points.
    centres = [(np.bincount(labels, part, count) / size).astype(np.float32) for part in (x, y)]
    if pattern != "none":
        transmission = transmission / bright_level(transmission[field])
    block = np.full((height, width), count, dtype=np.int32)
    block[outline] = labels
    return Bundle(
        pattern=pattern,
        pitch=float(_BLOCK),
        radius=_BLOCK / np.pi**0.5,
        centres=np.stack(centres, axis=1).astype(np.float64),
        labels=block,
        transmission=torch.where(field, transmission, torch.zeros_like(transmission)).cpu().numpy(),
        gains=np.ones((count, 1), np.float32),
        gain_weights=np.full(count, gain_weight, np.float32),
        offsets=np.zeros((count, 1), np.float32),
        black=in_units(black, acquisition),
        dead=np.empty((0, 2)),
        saturated=np.zeros(count, dtype=bool),
        outline=outline,
        provenance=provenance,
    )
