"""Gaussian filters of images."""

import math

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from napari_fiberburst.operators import steady


def blur(images: Tensor, sigma: float) -> Tensor:
    """Filter images (..., H, W) by a Gaussian of `sigma` nodes; outside is 0."""
    reach = math.ceil(4 * sigma)
    shape = [int(next_fast_len(side + reach, real=True)) for side in images.shape[-2:]]
    along_y, along_x = (
        torch.exp(-2 * (math.pi * sigma * frequencies(side, device=images.device)) ** 2)
        for side, frequencies in zip(shape, (torch.fft.fftfreq, torch.fft.rfftfreq), strict=True)
    )
    spectrum = torch.fft.rfft2(images, s=shape) * (along_y[:, None] * along_x)
    filtered: Tensor = steady.irfft2(spectrum, tuple(shape))[..., : images.shape[-2], : images.shape[-1]]
    return filtered


def filled_mean(totals: Tensor, mass: Tensor, sigma: float) -> Tensor:
    """Return the local mean (..., H, W) of scattered values, over a Gaussian of `sigma` nodes and wider where none is.

    Parameters
    ----------
    totals : Tensor
        (..., H, W), what values times their weights add to each node.
    mass : Tensor
        (H, W), what the weights add.
    sigma : float
        Nodes.
    """
    parts = torch.cat([totals.reshape(-1, *mass.shape), mass[None]])
    near = blur(parts, sigma)
    far = blur(near, 3 * sigma)
    everywhere = torch.stack([steady.total(part) for part in parts])[:-1, None, None]
    everywhere = everywhere / steady.total(mass).clamp_min(1e-12)
    faint = 1e-3 * steady.mean(near[-1]) + 1e-12
    filled = (far[:-1] + faint * everywhere) / (far[-1] + faint)
    mean: Tensor = (near[:-1] + faint * filled) / (near[-1] + faint)
    return mean.reshape(totals.shape)


def local_mean(image: Tensor, sigma: float, weight: Tensor | None = None) -> Tensor:
    """Return the Gaussian-weighted mean about each node of (H, W); 0 where nothing has weight."""
    weight = torch.ones_like(image) if weight is None else weight
    total, mass = blur(torch.stack([image * weight, weight]), sigma)
    mean: Tensor = total / mass.clamp_min(1e-4)
    return mean
