"""Calibrate a bundle from pictures of it in even light, with or without dark ones."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.calibrate import calibrating_mean, in_units, thinned
from napari_fiberburst.bundle.samples import SATURATED, sample_cores
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.device import find_device
from napari_fiberburst.errors import BundleError, BurstError
from napari_fiberburst.io.folder import read_picture
from napari_fiberburst.steps import drain

logger = logging.getLogger(__name__)

# A longer last axis is the width of the picture.
_MOST_CHANNELS = 15
# Part of the full scale that a bright pixel of an even flat reaches at least: below, there is nothing but noise.
_LEAST_BRIGHT = 0.004
# The black level is this quantile of a dark picture.
_BLACK_QUANTILE = 0.05
# Part of the pixels that may be saturated.
_MOST_SATURATED = 0.2


def calibrate_flat(
    image: ArrayLike | str | Path, dark: ArrayLike | str | Path | None, *, device: str = "auto"
) -> Bundle:
    """Calibrate as `Bundle.from_image` does."""
    name = _name(image, "the picture of the bundle in even light")
    flat = _pictures(image, name)
    black_name = _name(dark, "the dark picture")
    black = None if dark is None else _pictures(dark, black_name)
    if black is not None:
        flat, black = _alike(flat, black, name, black_name)
    if np.ptp(flat) == 0:
        level = "even" if flat.any() else "black"
        raise BundleError(
            f"{name} is {level} throughout and shows no bundle; light the bundle evenly, and focus on its cores"
        )
    levels = Burst(flat, axes="TYXC", black_level=min(0.0, float(flat.min())))
    _check_exposure(levels, name)
    place = find_device(device)
    frames = torch.from_numpy(levels.frames).to(place)
    mean = frames.mean(dim=(0, 3))
    told = {"source": "image", "bursts": 0, "frames": len(flat)}
    if isinstance(image, str | Path):
        told |= {"image": str(image)}
    if black is not None:
        span = levels.white_level - levels.black_level
        darkness = torch.from_numpy((black.mean(axis=0) - levels.black_level) / span).float().to(place)
        base = float(torch.quantile(thinned(darkness.mean(dim=2)), _BLACK_QUANTILE))
        light = mean - darkness.mean(dim=2)
        told |= {"dark": str(dark) if isinstance(dark, str | Path) else True}
    else:
        light = mean
    bundle = drain(calibrating_mean(light.clamp_min(0), levels, told, even_light=True))
    if bundle.pattern == "none":
        raise BundleError(
            f"{name} shows no bundle; expected a pattern of cores 2.3 to 24 px apart in even light; give another one"
        )
    if black is not None:
        bundle = replace(bundle, black=in_units(base, levels))
        offsets = sample_cores(darkness[None], replace(bundle, saturated=bundle.saturated), levels).values[0]
        bundle = replace(bundle, offsets=(offsets.cpu().numpy() * span).astype(np.float32))
    seen = sample_cores(frames, bundle, levels)
    values = (seen.values * seen.weights[..., None]).sum(dim=0) / seen.weights.sum(dim=0).clamp_min(1e-9)[:, None]
    gains = values / values.mean(dim=1, keepdim=True).clamp_min(1e-9)
    gains = gains / gains.median(dim=0).values.clamp_min(1e-9)
    usable = torch.isfinite(gains).all(dim=1) & (gains > 0).all(dim=1) & (seen.weights.sum(dim=0) > 0)
    gains = torch.where(usable[:, None], gains, torch.ones_like(gains)).clamp(0.2, 5)
    weight = (seen.weights * seen.values.mean(dim=2).square()).sum(dim=0)
    return replace(
        bundle,
        gains=gains.cpu().numpy().astype(np.float32),
        gain_weights=weight.cpu().numpy().astype(np.float32),
    )


def _pictures(source: ArrayLike | str | Path, name: str) -> NDArray[np.generic]:
    """Return pictures as (T, H, W, C)."""
    try:
        pixels = np.asarray(read_picture(source) if isinstance(source, str | Path) else source)
    except BurstError as error:
        raise BundleError(str(error)) from error
    if pixels.ndim == 2:
        pixels = pixels[None, ..., None]
    elif pixels.ndim == 3:
        pixels = pixels[None] if pixels.shape[2] <= _MOST_CHANNELS else pixels[..., None]
    if pixels.ndim != 4 or pixels.dtype.kind not in "uif" or not np.isfinite(pixels).all():
        raise BundleError(
            f"{name} must hold finite intensities, (H, W), (H, W, C) or several of them, (T, H, W) or (T, H, W, C); "
            f"got shape {pixels.shape} of {pixels.dtype}"
        )
    return pixels


def _alike(
    flat: NDArray[np.generic], dark: NDArray[np.generic], name: str, black_name: str
) -> tuple[NDArray[np.generic], NDArray[np.generic]]:
    """Return both, of the same number of channels; refuse a dark picture of another size, or one that is brighter."""
    if flat.shape[1:3] != dark.shape[1:3]:
        raise BundleError(
            f"{black_name} must have the size of {name}, {flat.shape[1]} x {flat.shape[2]}; got {dark.shape[1]} x "
            f"{dark.shape[2]}; take both with the same camera settings"
        )
    if dark.shape[3] != flat.shape[3]:
        dark = np.repeat(dark.mean(axis=3, keepdims=True), flat.shape[3], axis=3)
    if dark.mean() >= flat.mean():
        raise BundleError(
            f"{black_name} is brighter than {name}: {dark.mean():.4g} on average, expected less than "
            f"{flat.mean():.4g}; exchange the two, or take them again with the same exposure"
        )
    return flat, dark


def _check_exposure(flat: Burst, name: str) -> None:
    frames = flat.frames
    if np.quantile(frames[:, ::3, ::3], 0.99) < _LEAST_BRIGHT:
        raise BundleError(
            f"{name} is black: 99 % of its pixels lie below {_LEAST_BRIGHT:.1%} of full scale; light the bundle "
            "evenly, or expose longer"
        )
    share = float((frames.max(axis=3) >= SATURATED).mean())
    is_integer = flat.dtype.kind in "ui"
    if share > _MOST_SATURATED and (is_integer or np.ptp(frames[frames >= SATURATED]) == 0):
        raise BundleError(
            f"{name} is saturated: {share:.0%} of its pixels are at full scale, expected at "
            f"most {_MOST_SATURATED:.0%}; expose shorter, so that the brightest core stays below it"
        )


def _name(source: object, otherwise: str) -> str:
    return str(source) if isinstance(source, str | Path) else otherwise
