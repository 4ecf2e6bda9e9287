"""The bundle's calibration, from the burst alone.

The object moves and the bundle does not, so the mean of the frames, divided by itself blurred over a few cores, shows
the bundle: its pitch, its cores, and how much light each pixel passes. What is left of the object in it is told apart
after the frames have been aligned (see `napari_fiberburst.motion.joint` and `refined`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from napari_fiberburst.bundle.cores import REACH, brightest, find_cores, find_gaps, footprint_radius, nearest_core
from napari_fiberburst.bundle.pitch import find_pitch
from napari_fiberburst.errors import BurstError
from napari_fiberburst.operators.grid import blur, local_mean

# Over this many pitches the mean frame is blurred to tell bundle from object. One pitch takes gain for object: it
# leaves faint clouds that hold a low-contrast object still; many leave the object in the calibration.
_ENVELOPE = 3.0
# Below this pitch cores cannot be told apart, and pixels stand for themselves.
LEAST_RESOLVED_PITCH = 2.9
# Pixels to a side of the blocks that stand for cores where there are none.
_BLOCK = 4
_LEAST_CORES = 20
# Part of the light of a well-lit place below which a place lies outside the bundle.
_DARK = 0.04


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """What is known of a bundle. Tensors are on the run's device.

    Attributes
    ----------
    pitch : float
        Distance of neighbouring cores, pixels; of blocks of pixels where no cores can be told apart.
    has_bundle : bool
        Whether the pictures show a bundle at all.
    is_resolved : bool
        Whether its cores can be told apart.
    is_trusted : bool
        Whether the transmission comes from a calibration image, so that gains need not be found.
    black : float
        Intensity, 0 to 1, that stands for no light.
    transmission : Tensor
        (H, W), 1 where a typical core is brightest; 0 outside the cores.
    labels : Tensor
        (H, W) int64, the core that each pixel shows; N where none.
    centres : Tensor
        (N, 2) as (x, y).
    dead : numpy.ndarray
        (M, 2), places in the lattice without light.
    radius : float
        Of a core's footprint, pixels.
    """

    pitch: float
    has_bundle: bool
    is_resolved: bool
    is_trusted: bool
    black: float
    transmission: Tensor
    labels: Tensor
    centres: Tensor
    dead: np.ndarray
    radius: float

    @property
    def remark(self) -> str:
        """What a user should know of the bundle; nothing where all is as usual."""
        if not self.has_bundle:
            return "no bundle is seen in the frames; they are taken as plain pictures"
        return "" if self.is_resolved else "the cores are too close to be told apart; pixels stand for themselves"

    def refined(self, transmission: Tensor) -> "Calibration":
        """Return the calibration with a better transmission (H, W), in its scale where it is brightest."""
        own = self.labels < len(self.centres)
        transmission = torch.where(own, transmission.clamp_min(0), torch.zeros_like(transmission))
        transmission = transmission / _bright(transmission[own])
        radius = footprint_radius(transmission, self.labels, self.centres, self.pitch)
        return replace(self, transmission=transmission, radius=radius if self.is_resolved else self.radius)

    def with_even_gains(self) -> "Calibration":
        """Return the calibration with all cores equally bright, for bursts in which gain and object look the same."""
        if not self.is_resolved or self.is_trusted:
            return self
        own = self.labels < len(self.centres)
        peaks = brightest(self.transmission, self.labels, len(self.centres), self.pitch)
        transmission = torch.zeros_like(self.transmission)
        transmission[own] = self.transmission[own] / peaks[self.labels[own]]
        return self.refined(transmission)


def calibrate(frames: Tensor, image: Tensor | None = None) -> Calibration:
    """Calibrate the bundle.

    Raises BurstError where the image shows no bundle though the frames do.

    Parameters
    ----------
    frames : Tensor
        (T, H, W) grey intensities, 0 to 1.
    image : Tensor, optional
        (H, W), the bundle with nothing but even light before it, 0 to 1; never needed.
    """
    mean = frames.mean(dim=0) if image is None else image
    pitch = find_pitch(mean)
    if pitch is None and image is not None and find_pitch(frames.mean(dim=0)) is not None:
        raise BurstError("the calibration image shows no bundle, but the frames do; give another one, or leave it out")
    if pitch is None:
        return _blocks(torch.ones_like(mean), has_bundle=False, black=0.0)
    black = float(torch.quantile(_sample(mean), 0.002))
    light = (mean - black).clamp_min(0)
    envelope = local_mean(light, _ENVELOPE * pitch)
    outline = envelope > _DARK * torch.quantile(_sample(envelope), 0.95)
    envelope = local_mean(light, _ENVELOPE * pitch, outline.to(light)).clamp_min(1e-6)
    flat = torch.where(outline, light / envelope, torch.zeros_like(light))
    if pitch < LEAST_RESOLVED_PITCH:
        return _blocks(flat if image is None else light, has_bundle=True, black=black, is_trusted=image is not None)
    centres = find_cores(flat, pitch, outline)
    if len(centres) < _LEAST_CORES:
        return _blocks(torch.ones_like(mean), has_bundle=False, black=0.0)
    labels = torch.from_numpy(nearest_core(centres, outline.cpu().numpy(), REACH * pitch)).to(mean.device)
    draft = Calibration(
        pitch=pitch,
        has_bundle=True,
        is_resolved=True,
        is_trusted=image is not None,
        black=black,
        transmission=flat,
        labels=labels,
        centres=torch.from_numpy(centres).to(mean),
        dead=find_gaps(centres, _filled(labels < len(centres), pitch), pitch),
        radius=0.36 * pitch,
    )
    return draft.refined(flat if image is None else light)


def remeasure(calibration: Calibration, frames: Tensor, predicted: Callable[[int, Tensor], Tensor]) -> Calibration:
    """Measure the transmission anew, pixel by pixel, once it is known what the object shows there.

    Parameters
    ----------
    calibration : Calibration
        As it is.
    frames : Tensor
        (T, H, W) grey intensities.
    predicted : callable
        Takes a frame's number and pixels (N, 2), and returns the object's light there, (N,); 0 where unknown.
    """
    own = calibration.labels < len(calibration.centres)
    pixels = own.nonzero().flip(1).to(frames.dtype)
    light, power = torch.zeros(len(pixels)).to(frames), torch.full((len(pixels),), 1e-9).to(frames)
    for number, frame in enumerate(frames):
        seen = predicted(number, pixels)
        light += (frame[own] - calibration.black) * seen
        power += seen**2
    transmission = torch.zeros_like(calibration.transmission)
    known = power > 1e-3 * power.mean()
    fallback = calibration.transmission[own] * (light[known].sum() / power[known].sum().clamp_min(1e-9))
    transmission[own] = torch.where(known, light / power, fallback)
    return calibration.refined(transmission)


def _blocks(transmission: Tensor, *, has_bundle: bool, black: float, is_trusted: bool = False) -> Calibration:
    """Return a calibration whose cores are square blocks of pixels."""
    height, width = transmission.shape
    columns = -(-width // _BLOCK)
    row, column = (torch.arange(side, device=transmission.device) // _BLOCK for side in (height, width))
    labels = row[:, None] * columns + column[None, :]
    count = int(labels.max()) + 1
    y, x = torch.meshgrid(
        torch.arange(height, device=labels.device), torch.arange(width, device=labels.device), indexing="ij"
    )
    size = torch.bincount(labels.ravel(), minlength=count)
    centres = torch.stack(
        [torch.bincount(labels.ravel(), part.ravel().float(), count) / size for part in (x, y)], dim=1
    )
    if has_bundle:
        transmission = transmission / _bright(transmission)
    return Calibration(
        pitch=float(_BLOCK),
        has_bundle=has_bundle,
        is_resolved=False,
        is_trusted=is_trusted or not has_bundle,
        black=black,
        transmission=transmission,
        labels=labels,
        centres=centres.to(transmission.dtype),
        dead=np.empty((0, 2)),
        radius=_BLOCK / np.pi**0.5,
    )


def _bright(values: Tensor) -> Tensor:
    return torch.quantile(_sample(values), 0.97).clamp_min(1e-9)


def _sample(values: Tensor) -> Tensor:
    """Return some of the values, evenly taken: torch.quantile takes only so many."""
    flat = values.reshape(-1)
    return flat[:: max(1, len(flat) // 100_000)]


def _filled(covered: Tensor, pitch: float) -> np.ndarray:
    """Return the bundle's area: the cores, and what lies between them."""
    filled: np.ndarray = (blur(covered.float(), pitch) > 0.45).cpu().numpy()
    return filled
