"""Registration without honeycomb: from core samples to the transform of every frame, and how far to trust it.

Coarse, by cross-correlation normalised by the overlap (Padfield, 2012): whitened phase correlation locks on the bundle
or on noise. All pairs that are alike give the shifts, so motion may exceed the field as long as some frames overlap.
Fine, by `napari_fiberburst.motion.joint`.
"""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.motion.correlation import CHANCE, OverlapCorrelation
from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.motion.pairs import CoarseShifts, placed
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.grid import Grid

# Images for the coarse search have at most this many pixels a side.
_MOST_SIDE = 128
# Up to this many frames every pair is tried; beyond, neighbours in time and every frame with these many landmarks.
_ALL_PAIRS = 20
_NEIGHBOURS = 3
_LANDMARKS = 8
# Of so many frames the spectra are kept, at most.
_KEPT = 128
# Brightness and contrast of the images are evened out over so many of their pixels (sigma of a Gaussian), contrast
# where it is more than this part of the usual one.
_NEIGHBOURHOOD, _LEAST_CONTRAST = 4.0, 0.5
# Images that are this little alike do not show the same thing, or less than they may be by chance, up to the second.
LEAST_CONFIDENCE, _MOST_BY_CHANCE = 0.3, 0.5
# Frames that travel less than this, in pitches, or whose pairs miss by more than this part of the travel, may be held
# by what stands still in them. Of at least so many frames, the mean tells what that is; darker places than this part of
# its mean tell nothing.
_SHORT_TRAVEL, _UNCLEAR, _FEWEST, _LEAST_LIGHT = 1.0, 0.08, 4, 0.05
# Without it, frames that were held travel so many times as far, and their pairs miss by no more than this part of that;
# of so many pairs to a frame, because fewer cannot contradict one another.
_FARTHER, _CLEAR, _PAIRS_EACH = 1.3, 0.12, 2


def find_shifts(
    positions: Tensor, values: Tensor, weights: Tensor, shape: tuple[int, int], pitch: float
) -> CoarseShifts:
    """Find the shift of every frame to within about a pitch.

    What stands still in all frames, such as uneven light or gains, is alike where they are not shifted. Where it may
    hold them there, because they hardly seem to move or their pairs contradict one another, they are compared once more
    by how they differ from their mean.

    Parameters
    ----------
    positions : Tensor
        (N, 2) of the cores or blocks of pixels, frame pixels.
    values, weights : Tensor
        (T, N).
    shape : (int, int)
        Height and width of a frame.
    pitch : float
        Distance of neighbouring positions, pixels.
    """
    found = _find(positions, values, weights, shape, pitch)
    is_clear = found.travel > _SHORT_TRAVEL * pitch and found.missed < _UNCLEAR * found.travel
    if is_clear or len(values) < _FEWEST:
        return found
    mean = (weights * values).sum(dim=0) / weights.sum(dim=0).clamp_min(1e-9)
    changing = values / mean.clamp_min(_LEAST_LIGHT * float(mean.mean())).clamp_min(1e-9)
    apart = _find(positions, changing, weights, shape, pitch)
    is_told = apart.connected.sum() >= found.connected.sum() and apart.pairs >= _PAIRS_EACH * apart.connected.sum()
    is_held = apart.travel > _FARTHER * found.travel and apart.missed < _CLEAR * apart.travel
    return apart if is_told and is_held else found


def _find(positions: Tensor, values: Tensor, weights: Tensor, shape: tuple[int, int], pitch: float) -> CoarseShifts:
    """Find shifts by what frames show."""
    spacing = spacing_of(shape, pitch)
    height, width = shape
    grid = Grid.over((0, 0, width - 1, height - 1), spacing)
    images, mask = _images(positions, values, weights, grid, max(0.5, 0.6 * pitch / spacing))
    count = len(images)
    correlation = OverlapCorrelation(lambda number: (images[number], mask[number]), grid.shape, _KEPT)
    scores = np.zeros((count, count))
    pairwise = np.zeros((count, count, 2))
    for first, second in _pairs(count):
        shift, score = correlation.best(first, second)
        scores[first, second] = scores[second, first] = score
        pairwise[first, second], pairwise[second, first] = shift, -shift
    pairwise *= spacing
    in_common = np.prod(np.clip(1 - np.abs(pairwise) / (width, height), 0, 1), axis=2) * len(positions)
    by_chance = CHANCE / np.sqrt(np.maximum(in_common, 1))
    return placed(scores, scores >= np.clip(by_chance, LEAST_CONFIDENCE, _MOST_BY_CHANCE), pairwise, spacing)


def spacing_of(shape: tuple[int, int], pitch: float) -> float:
    """Return from node to node of the images in which shifts are looked for, pixels: shifts are that coarse."""
    return max(0.6 * pitch, max(shape) / _MOST_SIDE)


def confidence(
    positions: Tensor, values: Tensor, weights: Tensor, motion: FrameMotion, pitch: float
) -> NDArray[np.float64]:
    """Return how well each frame agrees with the mean of all others where they overlap: correlation, 0 to 1."""
    points = motion.apply(positions)
    grid = Grid.around(points, 0.7 * pitch, 2 * pitch)
    at = [grid.at(frame) for frame in points]
    totals = torch.stack(
        [torch.stack([a.adjoint(v * w), a.adjoint(w)]) for a, v, w in zip(at, values, weights, strict=True)]
    )
    totals = blur(totals, 0.8)
    others = totals.sum(dim=0) - totals
    found = []
    for a, own, (light, mass), (own_light, own_mass) in zip(at, weights, others, totals, strict=True):
        enough = a(mass) > 0.5 * steady.mean(own)
        weight = own * enough * a.inside
        here = a(own_light) / a(own_mass).clamp_min(1e-9)
        there = a(light) / a(mass).clamp_min(1e-9)
        found.append(_correlation(here, there, weight))
    return np.array(found)


def _correlation(first: Tensor, second: Tensor, weight: Tensor) -> float:
    total = float(steady.total(weight))
    if total <= 0:
        return 0.0
    first = first - steady.total(weight * first) / total
    second = second - steady.total(weight * second) / total
    power = float(steady.total(weight * first**2) * steady.total(weight * second**2))
    return max(0.0, float(steady.total(weight * first * second)) / power**0.5) if power > 0 else 0.0


def _images(positions: Tensor, values: Tensor, weights: Tensor, grid: Grid, sigma: float) -> tuple[Tensor, Tensor]:
    """Return the frames as small even images (T, h, w), and where there is something to see, (T, h, w)."""
    at = grid.at(positions)
    light = blur(torch.stack([at.adjoint(v * w) for v, w in zip(values, weights, strict=True)]), sigma)
    mass = blur(torch.stack([at.adjoint(w) for w in weights]), sigma)
    mask = mass > 0.2 * steady.mean(mass)
    images = torch.where(mask, light / mass.clamp_min(1e-9), torch.zeros_like(light))
    return torch.stack([evened(*part, _NEIGHBOURHOOD) for part in zip(images, mask, strict=True)]), mask


def evened(image: Tensor, mask: Tensor, neighbourhood: float) -> Tensor:
    """Return an image (h, w) of one brightness and contrast about every pixel, over a Gaussian of so many nodes.

    What is bright, large and unlike the object, such as a reflection, would otherwise decide where a frame lies.
    """
    weight = mask.to(image)
    mean, square, mass = blur(torch.stack([image * weight, image.square() * weight, weight]), neighbourhood)
    mass = mass.clamp_min(1e-4)
    mean = mean / mass
    contrast = (square / mass - mean.square()).clamp_min(0).sqrt()
    usual = contrast[mask].median() if bool(mask.any()) else contrast.new_tensor(1.0)
    even: Tensor = (image - mean) * weight / (contrast + _LEAST_CONTRAST * usual).clamp_min(1e-9)
    return even


def _pairs(count: int) -> Iterator[tuple[int, int]]:
    landmarks = set(np.linspace(0, count - 1, _LANDMARKS).astype(int).tolist())
    for first in range(count):
        for second in range(first + 1, count):
            if count <= _ALL_PAIRS or second - first <= _NEIGHBOURS or first in landmarks or second in landmarks:
                yield first, second
