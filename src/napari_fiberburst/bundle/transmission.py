"""The transmission, measured once the frames are registered and the object is known."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.calibrate import with_transmission
from napari_fiberburst.bundle.samples import BundleTensors
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.operators import steady

# Part of the mean squared light below which a pixel has seen too little to tell its transmission.
_LEAST_LIGHT = 1e-3
# Gains are taken as at least this where offsets are divided by them.
_LEAST_GAIN = 0.02

Prediction = Callable[[int, Tensor], Tensor]


def remeasure(bundle: Bundle, grey: Tensor, acquisition: Acquisition, predicted: Prediction) -> Bundle:
    """Measure the transmission pixel by pixel, by what the object shows there in frame after frame.

    Parameters
    ----------
    bundle : Bundle
        As it is.
    grey : Tensor
        (T, H, W) frames that take part, in [0, 1].
    acquisition : Acquisition
        Of the burst.
    predicted : callable
        Takes a frame's number and pixels (N, 2), and returns the object's light there, (N,); 0 where it is unknown.
    """
    known = BundleTensors.of(bundle, acquisition, grey.device)
    own = known.own
    pixels = own.nonzero().flip(1).to(grey.dtype)
    light, power = torch.zeros(len(pixels)).to(grey), torch.full((len(pixels),), 1e-9).to(grey)
    for number, frame in enumerate(grey):
        expected = predicted(number, pixels)
        light += (frame[own] - known.black) * expected
        power += expected**2
    transmission = torch.zeros_like(known.transmission)
    enough = power > _LEAST_LIGHT * steady.mean(power)
    fallback = known.transmission[own] * (steady.total(light[enough]) / steady.total(power[enough]).clamp_min(1e-9))
    transmission[own] = torch.where(enough, light / power, fallback)
    return with_transmission(bundle, transmission)


def with_gains(bundle: Bundle, per_core: Tensor, per_channel: Tensor | None = None) -> Bundle:
    """Return the bundle with gains (N,) of its cores taken into its transmission, and (N, C) into its channels."""
    factor = np.append(per_core.cpu().numpy(), np.float32(1)).astype(np.float32)[bundle.labels]
    gains = bundle.gains if per_channel is None else (bundle.gains * per_channel.cpu().numpy()).astype(np.float32)
    # What a core shows by itself stays as it is in the frames, and is told as an amplitude of the profile.
    offsets = (bundle.offsets / np.maximum(per_core.cpu().numpy(), _LEAST_GAIN)[:, None]).astype(np.float32)
    return replace(bundle, transmission=bundle.transmission * factor, gains=gains, offsets=offsets)
