"""Registration without honeycomb: from core samples to the transform of every frame, and how far to trust it.

Coarse, by cross-correlation normalised by the overlap (Padfield, 2012): whitened phase correlation locks on the bundle
or on noise. The best-connected tree of pairs gives the shifts, so motion may exceed the field as long as some frames
overlap. Fine, by `napari_fiberburst.motion.joint`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from torch import Tensor

from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.filters import blur, local_mean
from napari_fiberburst.operators.grid import Grid

# Images for the coarse search have at most this many pixels a side.
_MOST_SIDE = 128
# Pairs need this much of the field in common; less is by chance too often alike.
_LEAST_OVERLAP = 0.12
# Up to this many frames every pair is tried; beyond, neighbours in time and every frame with these many landmarks.
_ALL_PAIRS = 20
_NEIGHBOURS = 3
_LANDMARKS = 8
# Correlations with masks that are kept for other pairs, at most.
_KEPT = 128
# Brightness and contrast of the images are evened out over so many of their pixels (sigma of a Gaussian), contrast
# where it is more than this part of the usual one.
_NEIGHBOURHOOD, _LEAST_CONTRAST = 4.0, 0.5
# Images that are this little alike do not show the same thing.
LEAST_CONFIDENCE = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class CoarseShifts:
    """Where each frame lies, by shifts alone.

    Attributes
    ----------
    shifts : numpy.ndarray
        (T, 2) pixels, frame to scene.
    confidence : numpy.ndarray
        (T,) correlation, 0 to 1, of the pair that ties a frame to the others.
    connected : numpy.ndarray
        (T,) bool, frames that are tied to the best-connected one.
    """

    shifts: NDArray[np.float64]
    confidence: NDArray[np.float64]
    connected: NDArray[np.bool_]


def find_shifts(
    positions: Tensor, values: Tensor, weights: Tensor, shape: tuple[int, int], pitch: float
) -> CoarseShifts:
    """Find the shift of every frame to within about a pitch.

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
    spacing = max(0.6 * pitch, max(shape) / _MOST_SIDE)
    images, mask = _images(positions, values, weights, shape, spacing, max(0.5, 0.6 * pitch / spacing))
    correlation = _Correlation(images, mask)
    count = len(images)
    scores = np.zeros((count, count))
    pairwise = np.zeros((count, count, 2))
    for first, second in _pairs(count):
        shift, score = correlation.best(first, second)
        scores[first, second] = scores[second, first] = score
        pairwise[first, second], pairwise[second, first] = shift, -shift
    return _span(scores, pairwise * spacing)


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


def _images(
    positions: Tensor, values: Tensor, weights: Tensor, shape: tuple[int, int], spacing: float, sigma: float
) -> tuple[Tensor, Tensor]:
    """Return the frames as small images (T, h, w), and where there is something to see, (T, h, w)."""
    height, width = shape
    at = Grid.over((0, 0, width - 1, height - 1), spacing).at(positions)
    light = blur(torch.stack([at.adjoint(v * w) for v, w in zip(values, weights, strict=True)]), sigma)
    mass = blur(torch.stack([at.adjoint(w) for w in weights]), sigma)
    mask = mass > 0.2 * steady.mean(mass)
    return _normalised(torch.where(mask, light / mass.clamp_min(1e-9), torch.zeros_like(light)), mask), mask


def _normalised(images: Tensor, mask: Tensor) -> Tensor:
    """Return images (T, h, w) brought to one mean and contrast about every pixel.

    What is bright, large and unlike the object, such as a reflection, would otherwise decide where a frame lies.
    """
    weight = mask.to(images)
    mean, square = (
        torch.stack([local_mean(image, _NEIGHBOURHOOD, own) for image, own in zip(part, weight, strict=True)])
        for part in (images, images.square())
    )
    contrast = (square - mean.square()).clamp_min(0).sqrt()
    usual = contrast[mask].median() if bool(mask.any()) else contrast.new_tensor(1.0)
    return (images - mean) * weight / (contrast + _LEAST_CONTRAST * usual).clamp_min(1e-9)


def _pairs(count: int) -> Iterator[tuple[int, int]]:
    landmarks = set(np.linspace(0, count - 1, _LANDMARKS).astype(int).tolist())
    for first in range(count):
        for second in range(first + 1, count):
            if count <= _ALL_PAIRS or second - first <= _NEIGHBOURS or first in landmarks or second in landmarks:
                yield first, second


class _Correlation:
    """Correlation coefficients of pairs of masked images, over their overlap, for every shift at once."""

    def __init__(self, images: Tensor, masks: Tensor) -> None:
        self._shape = tuple(int(next_fast_len(2 * side, real=True)) for side in images.shape[1:])
        masks = masks.to(images.dtype)
        mass = masks.sum(dim=(1, 2), keepdim=True).clamp_min(1)
        centred = (images - (images * masks).sum(dim=(1, 2), keepdim=True) / mass) * masks
        # Most bursts have one mask for all frames, so what is correlated with it serves many pairs.
        numbers: dict[bytes, int] = {}
        self._mask_of = [numbers.setdefault(mask.cpu().numpy().tobytes(), i) for i, mask in enumerate(masks)]
        self._overlap = lru_cache(maxsize=_KEPT)(self._overlap_of)
        self._side = lru_cache(maxsize=_KEPT)(self._side_of)
        self._area = masks.sum(dim=(1, 2))
        self._power = centred.square().sum(dim=(1, 2))
        self._spectra = {
            name: torch.fft.rfft2(part, s=self._shape)
            for name, part in (("mask", masks), ("value", centred), ("square", centred.square()))
        }

    def best(self, first: int, second: int) -> tuple[NDArray[np.float64], float]:
        """Return the shift (x, y) from the second image to the first, in their pixels, and its score."""
        if not float(torch.minimum(self._area[first], self._area[second])) > 0:
            return np.zeros(2), 0.0
        mask, mask_second = self._mask_of[first], self._mask_of[second]
        sums, scale = self._side(first, mask_second, True)
        sums_second, scale_second = self._side(second, mask, False)
        # Shifts that leave too little in common have the scale 0.
        score = (self._correlate("value", first, "value", second) - sums * sums_second) * scale * scale_second
        place = int(score.argmax())
        shift = [place % self._shape[1], place // self._shape[1]]
        for axis, side in enumerate(self._shape[::-1]):
            shift[axis] -= side if shift[axis] > side // 2 else 0
        return -np.array(shift, dtype=np.float64), max(0.0, float(score.reshape(-1)[place]))

    def _overlap_of(self, mask: int, mask_second: int) -> tuple[Tensor, Tensor]:
        """Return how many pixels two masks have in common at every shift, and as a part of the smaller one."""
        overlap = self._correlate("mask", mask, "mask", mask_second).clamp_min(1e-3)
        return overlap, overlap / torch.minimum(self._area[mask], self._area[mask_second])

    def _side_of(self, image: int, other_mask: int, is_first: bool) -> tuple[Tensor, Tensor]:
        """Return what one image of a pair makes of the correlation: its sums over the overlap, and a scale.

        They depend on the other image's mask alone, so most pairs share them.
        """
        own_mask = self._mask_of[image]
        masks = (own_mask, other_mask) if is_first else (other_mask, own_mask)
        overlap, share = self._overlap(*masks)
        sums, squares = (
            self._correlate(part, image, "mask", other_mask)
            if is_first
            else self._correlate("mask", other_mask, part, image)
            for part in ("value", "square")
        )
        # Flat patches correlate by noise: a share of the whole image's power steadies the norm.
        power = (squares - sums**2 / overlap).clamp_min(0) + 0.02 * share * self._power[image]
        weight = torch.where(share > _LEAST_OVERLAP, share.clamp(0, 1) ** 0.125, torch.zeros_like(share))
        return sums / overlap.sqrt(), weight / power.sqrt().clamp_min(1e-6)

    def _correlate(self, part: str, first: int, part_second: str, second: int) -> Tensor:
        """Return one part of an image correlated with another part of a second image, at every shift."""
        spectrum = steady.complex_product(self._spectra[part][first].conj(), self._spectra[part_second][second])
        correlated: Tensor = steady.irfft2(spectrum, self._shape)
        return correlated


def _span(scores: NDArray[np.float64], pairwise: NDArray[np.float64]) -> CoarseShifts:
    """Tie frames together along the tree of the best pairs; `pairwise[i, j]` leads from frame j's pixels to i's."""
    count = len(scores)
    root = int(np.argmax(np.median(scores, axis=1)))
    shifts = np.zeros((count, 2))
    trust = np.zeros(count)
    connected = np.zeros(count, dtype=bool)
    connected[root] = True
    for _ in range(count - 1):
        open_pairs = np.where(connected[:, None] & ~connected[None, :], scores, -1.0)
        known, new = np.unravel_index(int(open_pairs.argmax()), open_pairs.shape)
        if scores[known, new] < LEAST_CONFIDENCE:
            break
        shifts[new] = shifts[known] + pairwise[known, new]
        trust[new] = scores[known, new]
        connected[new] = True
    trust[root] = trust.max()
    return CoarseShifts(shifts, trust, connected)
