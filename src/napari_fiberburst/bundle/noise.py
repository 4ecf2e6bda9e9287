"""The camera's noise, measured in the burst itself: from what pixels of a core do that the core does not.

A core shows one value through its profile, so what is left of its pixels once profile and value are taken out is noise,
but for what every frame has alike and for what goes with the value, which is the error of the profile.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.samples import SATURATED, BundleTensors, Samples
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.operators import steady

# Only pixels that pass at least this part of a bright core's light are asked, and at most so many of them.
_LIT = 0.3
_MOST_PIXELS = 40_000
# Brightness is told apart in so many steps.
_STEPS = 12
# The dark has at least this part of the least noise that is seen anywhere.
_LEAST_READ = 0.1
# The median of the square of a normal variable of variance 1.
_MEDIAN_SQUARE = 0.4549


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Variance of a pixel: ``shot`` times its light plus ``read``, full scale 1 (Foi et al., 2008).

    Attributes
    ----------
    shot : float
        Variance per light: the reciprocal of the electrons at full scale.
    read : float
        Variance in the dark; the steps of the numbers are in it.
    """

    shot: float
    read: float

    def variance(self, light: Tensor) -> Tensor:
        """Return the variance of pixels that show this light."""
        return self.shot * light.clamp_min(0) + self.read

    def of_samples(self, bundle: Bundle, acquisition: Acquisition, samples: Samples) -> Tensor:
        """Return the variance of samples of whole cores as they were taken, averaged over their channels, (T, N)."""
        known = BundleTensors.of(bundle, acquisition, samples.values.device)
        count = len(known.centres)
        profile, labels = known.transmission[known.own], known.labels[known.own]
        power, third = (
            torch.zeros(count).to(profile).index_add_(0, labels, profile**order).clamp_min(1e-9) for order in (2, 3)
        )
        gains, offsets = (known.per_channel(part, 1)[:, 0] for part in (known.gains, known.offsets))
        light = samples.grey * gains + offsets
        return (self.shot * light.clamp_min(0) * third + self.read * power) / (power * gains) ** 2


def measure_noise(grey: Tensor, bundle: Bundle, acquisition: Acquisition, samples: Samples) -> Noise | None:
    """Measure the noise of grey frames (T, H, W) by the pixels of resolved cores; None where there are too few.

    Parameters
    ----------
    grey : Tensor
        (T, H, W) intensities in [0, 1].
    bundle, acquisition
        Of these frames.
    samples : Samples
        Of whole cores, grey, of the same frames.
    """
    if not bundle.is_resolved or len(grey) < 3:
        return None
    known = BundleTensors.of(bundle, acquisition, grey.device)
    lit = known.own & (known.transmission > _LIT)
    pixels = lit.nonzero()
    pixels = pixels[:: max(1, len(pixels) // _MOST_PIXELS)]
    y, x = pixels.unbind(dim=1)
    labels = known.labels[y, x]
    light = grey[:, y, x]
    gains, offsets = (known.per_channel(part, 1)[:, 0] for part in (known.gains, known.offsets))
    value = samples.values[..., 0][:, labels] * gains[labels] + offsets[labels]
    usable = ((light < SATURATED) & (samples.weights[:, labels] > 0)).to(light)
    left = light - known.black - known.transmission[y, x] * value
    # What goes with the value, and what all frames have alike, is the profile's error: two unknowns a pixel.
    count = usable.sum(dim=0)
    mean_value, mean_left = ((usable * part).sum(dim=0) / count.clamp_min(1) for part in (value, left))
    value, left = usable * (value - mean_value), usable * (left - mean_left)
    left = left - value * (value * left).sum(dim=0) / value.square().sum(dim=0).clamp_min(1e-12)
    enough = count >= 3
    # A core's own noise goes into its value: each of its pixels, whether it is asked or not, has a share of it.
    every, power = known.transmission[known.own], torch.zeros(len(bundle.centres)).to(light)
    power = power.index_add_(0, known.labels[known.own], every**2)
    own = (1 - known.transmission[y, x] ** 2 / power[labels].clamp_min(1e-9)).clamp_min(0.05)
    square = (left**2).sum(dim=0) / ((count - 2).clamp_min(1) * own)
    brightness = (usable * light).sum(dim=0) / count.clamp_min(1) - known.black
    return _line(brightness[enough].cpu().double(), square[enough].cpu().double(), len(grey), _of_rounding(light))


def _of_rounding(light: Tensor) -> float:
    """Return the variance that rounding to the steps of these numbers has; next to nothing where they have none."""
    levels = torch.unique(light)
    return float(levels.diff().median()) ** 2 / 12 if len(levels) > 1 else 0.0


def _line(light: Tensor, square: Tensor, count: int, rounding: float) -> Noise | None:
    """Return the line of variance over light through the medians of steps of brightness.

    A profile that is slightly wrong adds variance where there is much light, so that the line may go below 0 in the
    dark. No camera is without noise there, and cores before dark parts of the object would be held to none.
    """
    if len(light) < 10 * _STEPS:
        return None
    order = light.argsort()
    parts = torch.tensor_split(order, _STEPS)
    x = torch.stack([steady.mean(light[part]) for part in parts])
    # The median of a mean of squares is a little below their mean (Wilson and Hilferty, 1931).
    freedom = max(1, count - 2)
    y = torch.stack([square[part].median() for part in parts]) / (1 - 2 / (9 * freedom)) ** 3
    weight = 1 / y.clamp_min(1e-12)
    design = torch.stack([x, torch.ones_like(x)], dim=1) * weight[:, None]
    shot, read = torch.linalg.solve(design.T @ design, design.T @ (y * weight)).tolist()
    if shot < 0:
        return Noise(shot=0.0, read=float(y.mean()))
    least = max(rounding, _LEAST_READ * float(y.min()))
    if read < least:
        above = (y - least).clamp_min(0)
        return Noise(shot=float((weight**2 * x * above).sum() / (weight**2 * x * x).sum()), read=least)
    return Noise(shot=shot, read=read)
