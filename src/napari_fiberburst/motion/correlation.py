"""Cross-correlation normalised by the overlap (Padfield, 2012): how far one masked image lies from another.

Whitened phase correlation locks on the bundle, or on noise; this asks at every shift how alike two images are where
both see something.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from torch import Tensor

from napari_fiberburst.operators import steady

# Pairs need this much of the field in common; less is by chance too often alike.
LEAST_OVERLAP = 0.12
# Of N cores in common the best shift is alike by this over the root of N where nothing is the same.
CHANCE = 6.0
# Flat patches correlate by noise: a share of the whole image's power steadies the norm.
_STEADYING = 0.02

_Part = Literal["value", "square"]


class OverlapCorrelation:
    """Correlation coefficients of pairs of masked images, over their overlap, for every shift at once.

    Parameters
    ----------
    look_up : callable
        Gives image number i (h, w) and its mask (h, w) bool. It is asked for an image when a pair needs it.
    shape : (int, int)
        h and w.
    kept : int
        Of so many images the spectra are kept for other pairs.
    """

    def __init__(self, look_up: Callable[[int], tuple[Tensor, Tensor]], shape: tuple[int, int], kept: int) -> None:
        self._look_up = look_up
        self._shape = tuple(int(next_fast_len(2 * side, real=True)) for side in shape)
        # Most recordings have one mask for all frames, so what is correlated with it serves many pairs. A mask goes by
        # the number of the first image that had it.
        self._owners: dict[bytes, int] = {}
        self._mask = lru_cache(maxsize=kept)(self._mask_of)
        self._image = lru_cache(maxsize=kept)(self._image_of)
        self._overlap = lru_cache(maxsize=kept)(self._overlap_of)
        self._side = lru_cache(maxsize=2 * kept)(self._side_of)

    def best(
        self, first: int, second: int, near: tuple[NDArray[np.float64], float] | None = None
    ) -> tuple[NDArray[np.float64], float]:
        """Return the shift (x, y) from the second image to the first, in their pixels, and its score, 0 to 1.

        Parameters
        ----------
        first, second : int
            The images.
        near : (numpy.ndarray, float), optional
            A shift, and how many pixels from it to look.
        """
        images = self._image(first), self._image(second)
        if not min(image.area for image in images) > 0:
            return np.zeros(2), 0.0
        mask, mask_second = (image.mask for image in images)
        sums, scale = self._side(first, mask_second, True)
        sums_second, scale_second = self._side(second, mask, False)
        both = self._correlate(images[0].spectra["value"], images[1].spectra["value"])
        # Shifts that leave too little in common have the scale 0.
        score = (both - sums * sums_second) * scale * scale_second
        if near is not None:
            score = score * self._within(*near).to(score)
        row, column = divmod(int(score.argmax()), self._shape[1])
        shift = np.zeros(2)
        for axis, (at, along) in enumerate(((column, score[row]), (row, score[:, column]))):
            side = len(along)
            about = along[[(at - 1) % side, at, (at + 1) % side]]
            shift[axis] = at - (side if at > side // 2 else 0) + _summit(*about.tolist())
        return -shift, max(0.0, float(score[row, column]))

    def _within(self, shift: NDArray[np.float64], radius: float) -> Tensor:
        """Return which shifts are so near to one, in the order of the correlation."""
        y, x = (-torch.fft.fftfreq(side, d=1 / side) for side in self._shape)
        return torch.hypot(x[None, :] - shift[0], y[:, None] - shift[1]) <= radius

    def _mask_of(self, owner: int) -> Tensor:
        """Return the spectrum of the mask of an image."""
        image, mask = self._look_up(owner)
        spectrum: Tensor = torch.fft.rfft2(mask.to(image), s=self._shape)
        return spectrum

    def _image_of(self, number: int) -> "_Image":
        image, mask = self._look_up(number)
        owner = self._owners.setdefault(sha256(mask.cpu().numpy().tobytes()).digest(), number)
        weight = mask.to(image)
        area = float(weight.sum())
        centred = (image - (image * weight).sum() / max(area, 1.0)) * weight
        return _Image(
            mask=owner,
            area=area,
            power=float(centred.square().sum()),
            spectra={
                "value": torch.fft.rfft2(centred, s=self._shape),
                "square": torch.fft.rfft2(centred.square(), s=self._shape),
            },
        )

    def _overlap_of(self, mask: int, mask_second: int) -> tuple[Tensor, Tensor]:
        """Return how many pixels two masks have in common at every shift, and as a part of the smaller one."""
        overlap = self._correlate(self._mask(mask), self._mask(mask_second)).clamp_min(1e-3)
        # The first coefficient of a spectrum is the sum.
        area = min(float(self._mask(number)[0, 0].real) for number in (mask, mask_second))
        return overlap, overlap / area

    def _side_of(self, number: int, other_mask: int, is_first: bool) -> tuple[Tensor, Tensor]:
        """Return what one image of a pair makes of the correlation: its sums over the overlap, and a scale.

        They depend on the other image's mask alone, so most pairs share them.
        """
        image, mask = self._image(number), self._mask(other_mask)
        if not is_first and image.mask == other_mask:  # as the other way about, with all shifts reversed
            sums, scale = self._side(number, other_mask, True)
            return _reversed(sums), _reversed(scale)
        overlap, share = self._overlap(*((image.mask, other_mask) if is_first else (other_mask, image.mask)))
        sums, squares = (
            self._correlate(image.spectra[part], mask) if is_first else self._correlate(mask, image.spectra[part])
            for part in ("value", "square")
        )
        power = (squares - sums**2 / overlap).clamp_min(0) + _STEADYING * share * image.power
        weight = torch.where(share > LEAST_OVERLAP, share.clamp(0, 1) ** 0.125, torch.zeros_like(share))
        return sums / overlap.sqrt(), weight / power.sqrt().clamp_min(1e-6)

    def _correlate(self, first: Tensor, second: Tensor) -> Tensor:
        """Return what has one spectrum correlated with what has the other, at every shift."""
        correlated: Tensor = steady.irfft2(steady.complex_product(first.conj(), second), self._shape)
        return correlated


@dataclass(frozen=True, slots=True, eq=False)
class _Image:
    """What is kept of an image.

    Attributes
    ----------
    mask : int
        Number of the first image that had its mask.
    area : float
        Of the mask, pixels.
    power : float
        Sum of squares.
    spectra : dict
        Of the image about its mean, and of its square.
    """

    mask: int
    area: float
    power: float
    spectra: dict[_Part, Tensor]


def _summit(before: float, at: float, after: float) -> float:
    """Return where the parabola through three neighbours has its top, from the middle one, which is the highest.

    Where one of them is a shift that leaves too little in common, which is 0, the middle one is taken.
    """
    curvature = before - 2 * at + after
    if min(before, after) <= 0 or not curvature < 0:
        return 0.0
    return (before - after) / (2 * curvature)


def _reversed(image: Tensor) -> Tensor:
    """Return what stands at every shift at the opposite one."""
    return image.flip(0, 1).roll((1, 1), (0, 1))
