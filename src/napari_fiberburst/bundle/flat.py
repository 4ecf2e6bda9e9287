"""Calibrate a bundle from images of it in even light, with or without dark ones."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle, Images
from napari_fiberburst.bundle.calibrate import calibrating_mean, in_units, thinned, with_saturated
from napari_fiberburst.bundle.samples import SATURATED, sample_cores
from napari_fiberburst.data.burst import Acquisition, Burst
from napari_fiberburst.device import find_device
from napari_fiberburst.errors import BundleError, BurstError
from napari_fiberburst.io.folder import read_image
from napari_fiberburst.steps import drain

# A longer last axis is the width of the image.
_MOST_CHANNELS = 15
# Part of the full scale that a bright pixel of an even flat reaches at least: below, there is nothing but noise.
_LEAST_BRIGHT = 0.004
# The black level is this quantile of a dark image.
_BLACK_QUANTILE = 0.05
# Part of the pixels that may be saturated.
_MOST_SATURATED = 0.2
# A core's gain in a channel, relative to its gain in all, is not believed beyond these.
_LEAST_GAIN, _MOST_GAIN = 0.2, 5.0


def calibrate_flat(image: Images, dark: Images | None, *, device: str = "auto") -> Bundle:
    """Calibrate as `Bundle.from_image` does."""
    name, dark_name = _name(image, "the image of the bundle in even light"), _name(dark, "the dark image")
    flat = _images(image, name)
    black = None if dark is None else _alike(_images(dark, dark_name), flat, dark_name, name)
    levels = _in_levels(flat, name)
    place = find_device(device)
    frames = torch.from_numpy(levels.frames).to(place)
    light = frames.mean(dim=(0, 3))
    origin: dict[str, Any] = {"source": "image", "bursts": 0, "frames": len(flat), "files": _files(image)}
    if black is None:
        bundle = _found(light, levels, origin, name)
    else:
        span = levels.white_level - levels.black_level
        darkness = torch.from_numpy((black.mean(axis=0) - levels.black_level) / span).float().to(place)
        bundle = _found(light - darkness.mean(dim=2), levels, {**origin, "dark": _files(dark)}, name)
        bundle = _with_dark(bundle, darkness, levels)
    return _with_channels(with_saturated(bundle, frames.amax(dim=3)), frames, levels)


def _found(light: Tensor, acquisition: Acquisition, origin: dict[str, Any], name: str) -> Bundle:
    bundle = drain(calibrating_mean(light.clamp_min(0), acquisition, origin, even_light=True))
    if bundle.pattern == "none":
        raise BundleError(
            f"{name} shows no bundle; expected a pattern of cores 2.3 to 24 px apart in even light; give another one"
        )
    return bundle


def _with_dark(bundle: Bundle, darkness: Tensor, acquisition: Acquisition) -> Bundle:
    """Return the bundle with the black level and the offsets that a dark image (H, W, C) shows, full scale 1."""
    base = float(torch.quantile(thinned(darkness.mean(dim=2)), _BLACK_QUANTILE))
    bundle = replace(bundle, black=in_units(base, acquisition))
    offsets = sample_cores(darkness[None], bundle, acquisition).values[0]
    span = acquisition.white_level - acquisition.black_level
    return replace(bundle, offsets=(offsets.cpu().numpy() * span).astype(np.float32))


def _with_channels(bundle: Bundle, frames: Tensor, acquisition: Acquisition) -> Bundle:
    """Return the bundle with the gains of its cores in each channel, and how well they are known."""
    samples = sample_cores(frames, bundle, acquisition)
    mass = samples.weights.sum(dim=0)
    values = (samples.values * samples.weights[..., None]).sum(dim=0) / mass.clamp_min(1e-9)[:, None]
    gains = values / values.mean(dim=1, keepdim=True).clamp_min(1e-9)
    # What channels differ by in all cores is the colour of the light, and no gain.
    gains = gains / gains.median(dim=0).values.clamp_min(1e-9)
    usable = (values > 0).all(dim=1) & (mass > 0)
    gains = torch.where(usable[:, None], gains, torch.ones_like(gains)).clamp(_LEAST_GAIN, _MOST_GAIN)
    weights = (samples.weights * samples.values.mean(dim=2).square()).sum(dim=0) * usable
    return replace(
        bundle,
        gains=gains.cpu().numpy().astype(np.float32),
        gain_weights=weights.cpu().numpy().astype(np.float32),
    )


def _images(source: Images, name: str) -> NDArray[Any]:
    """Return images as (T, H, W, C)."""
    paths = _paths(source)
    if not paths:
        return _stacked(np.asarray(source), name)
    read = [_stacked(_read(path), str(path)) for path in paths]
    for path, images in zip(paths, read, strict=True):
        if images.shape[1:] != read[0].shape[1:]:
            raise BundleError(
                f"images of one bundle must be of one size; {path} has {_size(images)} where {paths[0]} has "
                f"{_size(read[0])}; take all with the same camera settings"
            )
    return np.concatenate(read)


def _stacked(pixels: NDArray[Any], name: str) -> NDArray[Any]:
    if pixels.ndim == 2:
        pixels = pixels[None, ..., None]
    elif pixels.ndim == 3:
        pixels = pixels[None] if pixels.shape[2] <= _MOST_CHANNELS else pixels[..., None]
    if pixels.ndim != 4 or pixels.dtype.kind not in "uif" or not pixels.size or not np.isfinite(pixels).all():
        raise BundleError(
            f"{name} must hold finite intensities, (H, W), (H, W, C) or several of them, (T, H, W) or (T, H, W, C); "
            f"got shape {pixels.shape} of {pixels.dtype}"
            + (" with NaN or infinity" if pixels.ndim == 4 and pixels.dtype.kind == "f" else "")
        )
    return pixels


def _read(path: str | Path) -> NDArray[Any]:
    try:
        return read_image(path)
    except BurstError as error:
        raise BundleError(str(error)) from error


def _alike(dark: NDArray[Any], flat: NDArray[Any], dark_name: str, name: str) -> NDArray[Any]:
    """Return dark images with as many channels as the flat; refuse them of another size, or brighter."""
    if flat.shape[1:3] != dark.shape[1:3]:
        raise BundleError(
            f"{dark_name} must have the size of {name}, {flat.shape[1]} x {flat.shape[2]}; got {dark.shape[1]} x "
            f"{dark.shape[2]}; take both with the same camera settings"
        )
    if dark.mean() >= flat.mean():
        raise BundleError(
            f"{dark_name} is brighter than {name}: {dark.mean():.4g} on average, expected less than "
            f"{flat.mean():.4g}; exchange the two, or take them again with the same exposure"
        )
    if dark.shape[3] != flat.shape[3]:
        dark = np.repeat(dark.mean(axis=3, keepdims=True), flat.shape[3], axis=3)
    return dark


def _in_levels(flat: NDArray[Any], name: str) -> Burst:
    """Return flats in [0, 1]; refuse black and saturated ones."""
    if np.ptp(flat) == 0:
        level = "even" if flat.any() else "black"
        raise BundleError(
            f"{name} is {level} throughout and shows no bundle; light the bundle evenly, and focus on its cores"
        )
    try:
        levels = Burst(flat, axes="TYXC", black_level=min(0.0, float(flat.min())))
    except BurstError as error:
        raise BundleError(f"{name} cannot show a bundle: {error}") from error
    frames = levels.frames
    if np.quantile(frames[:, ::3, ::3], 0.99) < _LEAST_BRIGHT:
        raise BundleError(
            f"{name} is black: 99 % of its pixels lie below {_LEAST_BRIGHT:.1%} of full scale; light the bundle "
            "evenly, or expose longer"
        )
    share = float((frames.max(axis=3) >= SATURATED).mean())
    if share > _MOST_SATURATED:
        raise BundleError(
            f"{name} is saturated: {share:.0%} of its pixels are at full scale, expected at "
            f"most {_MOST_SATURATED:.0%}; expose shorter, so that the brightest core stays below it"
        )
    return levels


def _paths(source: object) -> list[str | Path]:
    """Return the paths that images are given by; none where they are given as arrays."""
    if isinstance(source, str | Path):
        return [source]
    items = list(source) if isinstance(source, list | tuple) else []
    paths = [item for item in items if isinstance(item, str | Path)]
    return paths if len(paths) == len(items) else []


def _files(source: object) -> list[str]:
    """Return the names of files without their folders, which are nobody else's business."""
    return [Path(path).name for path in _paths(source)]


def _name(source: object, otherwise: str) -> str:
    return ", ".join(map(str, _paths(source))) or otherwise


def _size(images: NDArray[Any]) -> str:
    """Return height and width, and channels where there are several."""
    return " x ".join(str(side) for side in images.shape[1:] if side != 1)
