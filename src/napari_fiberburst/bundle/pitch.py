"""The pitch of a bundle, from the ring that its lattice draws in the spectrum."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.operators import steady
from napari_fiberburst.operators.filters import local_mean

# Pitches looked for, pixels. Below, cores and pixels beat; above, a frame holds too few cores to tell.
LEAST_PITCH, MOST_PITCH = 2.3, 24.0
# A bundle is told by two signs together: how far its ring stands out of the spectrum on both sides of it (natural
# logarithm of power), and how much the image varies about its own blur. Simulated bundles, jittered, few cores
# across, with bright fibres behind them, have 0.2 to 2.5 and 0.7 to 1.4; plain scenes at most 0.4 in the one and, where
# they have less than 0 there, 0.6 in the other.
_USUAL_CONTRAST, _LEAST_SIGN = 0.5, 0.3
# Faint bundles vary by 0.05 to 0.1, and their ring alone tells them: it has 1.1 to 3.5 where plain scenes have at most
# 0.5. What varies less is no bundle: the blocks of a compressed video draw a ring of 2 at 0.015. Neither is what lies
# at the end of the spectrum, where a ring has one side only.
_FAINT, _LEAST_CONTRAST, _CLEAR_RING = 0.1, 0.03, 1.0
# Rows of a hexagonal lattice stand closer than its cores.
_PITCH_PER_ROW = 2 / math.sqrt(3)


def find_pitch(image: Tensor, field: Tensor | None = None) -> float | None:
    """Return the distance of neighbouring cores in pixels, or None where the image shows no bundle.

    The spectrum is averaged over directions, so that a lattice of many grains, which has no direction of its own and
    draws a ring instead of six peaks, is found as well.

    Parameters
    ----------
    image : Tensor
        (H, W), such as the mean of a burst, in which the object is smeared and the bundle is not.
    field : Tensor, optional
        (H, W) bool, where to look; everywhere by default.
    """
    weight = torch.ones_like(image) if field is None else field.to(image)
    frequency, power = _radial_spectrum(image, weight)
    level = np.log(power + 1e-9 * power.max())
    level = np.convolve(np.pad(level, 2, mode="edge"), np.array([1, 4, 6, 4, 1]) / 16, mode="valid")
    best, peak, is_between = -np.inf, None, False
    for index, centre in enumerate(frequency):
        if not LEAST_PITCH <= _PITCH_PER_ROW / centre <= MOST_PITCH:
            continue
        below = (frequency > 0.45 * centre) & (frequency < 0.75 * centre)
        above = (frequency > 1.25 * centre) & (frequency < 1.6 * centre)
        sides = [np.median(level[side]) for side in (below, above) if side.any()]
        prominence = level[index] - max(sides, default=np.inf)
        if prominence > best:
            best, peak, is_between = prominence, index, len(sides) == 2
    if peak is None:
        return None
    near = slice(max(0, peak - 2), peak + 3)
    pitch = float(_PITCH_PER_ROW / np.average(frequency[near], weights=power[near]))
    contrast = _contrast(image, pitch, weight)
    if contrast < _FAINT:
        is_bundle = contrast > _LEAST_CONTRAST and best > _CLEAR_RING and is_between
    else:
        is_bundle = best + 2 * (contrast - _USUAL_CONTRAST) > _LEAST_SIGN
    return pitch if is_bundle else None


def ring_frequency(pitch: float) -> float:
    """Return the radius of the ring that a lattice of this pitch draws in the spectrum, cycles per pixel."""
    return _PITCH_PER_ROW / pitch


def _contrast(image: Tensor, pitch: float, weight: Tensor) -> float:
    """Return the standard deviation of an image about its own blur over three pitches, in parts of that."""
    envelope = local_mean(image, 3 * pitch, weight)
    lit = (envelope > 0.1 * envelope.max()) & (weight > 0)
    return float((image[lit] / envelope[lit]).std())


def _radial_spectrum(image: Tensor, weight: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies, cycles per pixel, and the mean power at each, with the image's slow changes divided out.

    What has no weight (H, W) is left out.
    """
    height, width = image.shape
    envelope = local_mean(image, 12.0, weight)
    flat = image / (envelope + 1e-3 * image.max())
    window = torch.hann_window(height, device=image.device)[:, None] * torch.hann_window(width, device=image.device)
    window = window * weight
    flat = (flat - steady.weighted_mean(flat, window)) * window
    power = torch.fft.rfft2(flat).abs().square().cpu()
    frequency = torch.hypot(torch.fft.fftfreq(height)[:, None], torch.fft.rfftfreq(width)[None, :])
    bins = max(64, min(height, width) // 2)
    number = (frequency * 2 * bins).long()
    inside = number < bins
    total = torch.bincount(number[inside], power[inside].double(), bins)
    count = torch.bincount(number[inside], minlength=bins).clamp_min(1)
    return (np.arange(bins) + 0.5) / bins / 2, (total / count).numpy()
