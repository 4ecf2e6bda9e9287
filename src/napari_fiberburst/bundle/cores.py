"""Find cores in an image of even light, and which pixels show which core."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import cKDTree
from torch import Tensor

from napari_fiberburst.bundle.lattice import REACH, nearest_core
from napari_fiberburst.operators.filters import blur, local_mean

# In pitches: how far from all cores a place is a gap in the lattice.
_GAP = 0.85
# A core is a blob: two Gaussians of these widths (1 sigma, in pitches), subtracted. Plain peaks would miss a dim core
# that leans on a bright one.
_INNER, _OUTER = 0.15, 0.3
# The mean profile is a broken line with knots this far apart, out to where neighbours of neighbours begin; what lies
# within the second reach is a core's own. In pitches. So many pixels are plenty.
_PROFILE_STEP, _PROFILE_REACH, _OWN_REACH = 0.1, 1.3, 0.7
_PROFILE_PIXELS = 20_000
# Part of the most light of a core that it may show midway to its neighbour.
_SPREAD = 0.1
# The camera blurs the profile, and a core gathers less through its rim than it shows there, so the profile is raised to
# this power before its moment is taken. Profiles in flat fields of a real bundle shrink by a fifth, sharp ones by 7 %.
# That gains 0.7 to 2.7 dB behind the former and costs nothing behind the latter, and in a real burst, frames left out
# are predicted best at 0.7 to 0.85 of the plain radius. In simulated bursts neither samples nor frames left out can
# choose it, because their error falls with every smaller radius.
_MOMENT_POWER = 1.5
# How strong a blob is a core, in parts of the light about it; and how much light there must be about it, because noise
# outside the bundle has blobs too.
_LEAST_BLOB = 0.06
_LEAST_LIGHT = 0.15
# Bundles whose blobs are usually (median, of either sign) fainter than this, in the same parts, are faint: their cores
# are the blobs stronger than this part of a usual one.
_FAINT, _LEAST_OF_USUAL = 0.03, 0.3


def find_cores(image: Tensor, pitch: float, outline: Tensor) -> NDArray[np.float64]:
    """Return core centres (N, 2) as (x, y), to a fraction of a pixel.

    Blobs of the size of a core, moved to the centroid of the light about them.

    Parameters
    ----------
    image : Tensor
        (H, W), how bright each pixel is in even light, about 1 on average.
    pitch : float
        Distance of neighbouring cores, pixels.
    outline : Tensor
        (H, W) bool, where the bundle is.
    """
    blob, around = _blobs(image, pitch)
    usual = _usual_blob(image, pitch, outline)
    least = _LEAST_BLOB if usual >= _FAINT else _LEAST_OF_USUAL * usual
    is_core = (blob == _extreme(blob, round(0.2 * pitch))) & (blob > least * around)
    is_core &= outline & (around > _LEAST_LIGHT)
    peaks = is_core.nonzero().flip(1).cpu().numpy().astype(np.float64)
    if len(peaks) == 0:
        return peaks
    light = image.square().cpu().numpy().ravel().astype(np.float64)
    labels = nearest_core(peaks, outline.cpu().numpy(), REACH * pitch).ravel()
    own = labels < len(peaks)
    y, x = (part.ravel()[own] for part in np.indices(image.shape))
    total, along_x, along_y = (
        np.bincount(labels[own], light[own] * weight, len(peaks)) for weight in (np.ones(len(x)), x, y)
    )
    found = total > 0
    return np.stack([along_x[found] / total[found], along_y[found] / total[found]], axis=1)


def find_gaps(centres: NDArray[np.float64], outline: NDArray[np.bool_], pitch: float) -> NDArray[np.float64]:
    """Return where the lattice has a place but no light, (M, 2): dead cores."""
    if len(centres) < 6:
        return np.empty((0, 2))
    y, x = np.nonzero(outline)
    distance = np.zeros(outline.shape)
    distance[y, x] = cKDTree(centres).query(np.stack([x, y], axis=1), workers=-1)[0]
    field = torch.from_numpy(distance)
    is_gap = (field == _extreme(field, round(0.5 * pitch))) & (field > _GAP * pitch)
    gaps = is_gap.nonzero().flip(1).numpy().astype(np.float64)
    # At the rim the lattice simply ends: a gap has cores on all sides.
    if len(gaps) == 0:
        return gaps
    _, near = cKDTree(centres).query(gaps, k=6)
    middle = centres[near].mean(axis=1)
    inside: NDArray[np.float64] = gaps[np.hypot(*(gaps - middle).T) < 0.6 * pitch]
    return inside


def brightest(transmission: Tensor, labels: Tensor, count: int, pitch: float) -> Tensor:
    """Return how bright each core is where it is brightest, (N,)."""
    own = labels < count
    smooth = blur(transmission, max(0.1 * pitch, 0.3))
    return torch.zeros(count).to(smooth).scatter_reduce(0, labels[own], smooth[own], "amax").clamp_min(1e-6)


def footprint_radius(transmission: Tensor, labels: Tensor, centres: Tensor, pitch: float) -> float:
    """Return the radius, in pixels, of the disc with the variance of the mean core's profile to the power of 1.5.

    A core gathers light over the area through which it emits it, and less at its rim. Profiles of neighbours overlap,
    so the mean profile is unmixed: every pixel is a sum of its neighbours' profiles, one function of the distance for
    all cores (least squares, not negative). Its second moment is taken as far as it is a core's own; farther out lies
    stray light. So does what is left midway between neighbours, beyond the tenth that optics spread there: in a faint
    bundle that is half of the light, and the disc would be half as large again.
    """
    gains = brightest(transmission, labels, len(centres), pitch).cpu().numpy()
    y, x = np.nonzero((labels < len(centres)).cpu().numpy())
    some = slice(None, None, max(1, len(x) // _PROFILE_PIXELS))
    x, y = x[some], y[some]
    distance, nearest = cKDTree(centres.cpu().numpy()).query(np.stack([x, y], axis=1), k=8)
    place = np.asarray(distance) / (_PROFILE_STEP * pitch)
    knots = math.ceil(_PROFILE_REACH / _PROFILE_STEP) + 1
    below = np.minimum(place.astype(int), knots)
    entry = np.arange(len(x))[:, None] * (knots + 2) + below
    gain = gains[nearest]
    parts = np.stack([gain * (1 - place + below).clip(0, 1), gain * (place - below).clip(0, 1)])
    design = np.bincount(np.stack([entry, entry + 1]).ravel(), parts.ravel(), len(x) * (knots + 2)).reshape(len(x), -1)
    profile, _ = nnls(design[:, :knots], transmission.cpu().numpy()[y, x].astype(np.float64))
    at, radius = np.arange(knots) * _PROFILE_STEP, np.linspace(0, _OWN_REACH, 200)
    stray = max(0.0, np.interp(0.5, at, profile) - _SPREAD * profile.max())
    light = (np.interp(radius, at, profile) - stray).clip(0) ** _MOMENT_POWER
    if not light.any():
        return 0.36 * pitch
    return float(pitch * math.sqrt(2 * (light * radius**3).sum() / (light * radius).sum()))


def _blobs(image: Tensor, pitch: float) -> tuple[Tensor, Tensor]:
    """Return how strong a blob each pixel is, and the light about it, (H, W)."""
    blob = blur(image, max(0.4, _INNER * pitch)) - blur(image, max(0.55, _OUTER * pitch))
    return blob, local_mean(image, 0.7 * pitch)


def _usual_blob(image: Tensor, pitch: float, outline: Tensor) -> float:
    """Return how strong blobs, bright or dark, usually are in parts of the light about them."""
    blob, around = (part[outline] for part in _blobs(image, pitch))
    return float((blob.abs() / around.clamp_min(1e-6)).median()) if len(blob) else 0.0


def _extreme(image: Tensor, reach: int) -> Tensor:
    """Return the largest value within `reach` pixels, square-wise."""
    reach = max(1, reach)
    return F.max_pool2d(image[None], 2 * reach + 1, stride=1, padding=reach)[0]
