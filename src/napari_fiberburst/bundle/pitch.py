"""The pitch of a bundle, from the ring that its lattice draws in the spectrum."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.operators.filters import local_mean

# Pitches looked for, pixels. Below, cores and pixels beat; above, a frame holds too few cores to tell.
LEAST_PITCH, MOST_PITCH = 2.3, 24.0
# A bundle is told by two signs together: how far its ring stands out of the spectrum on both sides of it (natural
# logarithm of power), and how much the image varies about its own blur. Simulated bundles, jittered, few cores
# across, with bright fibres behind them, have 0.2 to 2.5 and 0.7 to 1.4; plain scenes at most 0.4 in the one and, where
# they have less than 0 there, 0.6 in the other.
_USUAL_CONTRAST, _LEAST_CONTRAST = 0.5, 0.1
_LEAST_SIGN = 0.3
# Rows of a hexagonal lattice stand closer than its cores.
_PITCH_PER_ROW = 2 / math.sqrt(3)


def find_pitch(image: Tensor) -> float | None:
    """Return the distance of neighbouring cores in pixels, or None where the image shows no bundle.

    The spectrum is averaged over directions, so that a lattice of many grains, which has no direction of its own and
    draws a ring instead of six peaks, is found as well.

    Parameters
    ----------
    image : Tensor
        (H, W), such as the mean of a burst, in which the object is smeared and the bundle is not.
    """
    frequency, power = _radial_spectrum(image)
    level = np.log(power + 1e-9 * power.max())
    level = np.convolve(np.pad(level, 2, mode="edge"), np.array([1, 4, 6, 4, 1]) / 16, mode="valid")
    best, peak = -np.inf, None
    for index, centre in enumerate(frequency):
        if not LEAST_PITCH <= _PITCH_PER_ROW / centre <= MOST_PITCH:
            continue
        below = (frequency > 0.45 * centre) & (frequency < 0.75 * centre)
        above = (frequency > 1.25 * centre) & (frequency < 1.6 * centre)
        sides = [np.median(level[side]) for side in (below, above) if side.any()]
        prominence = level[index] - max(sides, default=np.inf)
        if prominence > best:
            best, peak = prominence, index
    if peak is None:
        return None
    near = slice(max(0, peak - 2), peak + 3)
    pitch = float(_PITCH_PER_ROW / np.average(frequency[near], weights=power[near]))
    envelope = local_mean(image, 3 * pitch)
    lit = envelope > 0.1 * envelope.max()
    contrast = float((image[lit] / envelope[lit]).std())
    if contrast < _LEAST_CONTRAST:
        return None
    return pitch if best + 2 * (contrast - _USUAL_CONTRAST) > _LEAST_SIGN else None


def ring_frequency(pitch: float) -> float:
    """Return the radius of the ring that a lattice of this pitch draws in the spectrum, cycles per pixel."""
    return _PITCH_PER_ROW / pitch


def _radial_spectrum(image: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies, cycles per pixel, and the mean power at each, with the image's slow changes divided out."""
    height, width = image.shape
    envelope = local_mean(image, 12.0)
    flat = image / (envelope + 1e-3 * image.max())
    window = torch.hann_window(height, device=image.device)[:, None] * torch.hann_window(width, device=image.device)
    flat = (flat - (flat * window).sum() / window.sum()) * window
    power = torch.fft.rfft2(flat).abs().square().cpu()
    frequency = torch.hypot(torch.fft.fftfreq(height)[:, None], torch.fft.rfftfreq(width)[None, :])
    bins = max(64, min(height, width) // 2)
    number = (frequency * 2 * bins).long()
    inside = number < bins
    total = torch.bincount(number[inside], power[inside].double(), bins)
    count = torch.bincount(number[inside], minlength=bins).clamp_min(1)
    return (np.arange(bins) + 0.5) / bins / 2, (total / count).numpy()
