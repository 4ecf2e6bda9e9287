"""One value a core and frame, fast: the sums that `bundle.samples` takes, as one sparse product."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.samples import SATURATED
from napari_fiberburst.live.levels import Levels

# A core counts at most as much as this many typical ones, and not at all below this part of one.
_MOST_WEIGHT, _LEAST_WEIGHT = 3.0, 0.02
# Part of its profile's power that a core may have in saturated pixels before it has no value.
_MOST_SATURATED = 0.02
# Pixels with less than this part of it are left out of the sums.
_LEAST_SHARE = 5e-4


@dataclass(frozen=True, slots=True, eq=False)
class CoreLight:
    """What the cores show in one frame.

    Attributes
    ----------
    values : numpy.ndarray
        (N, C) float32, the light of the scene at each core as a bright core would show it, full scale 1.
    weights : numpy.ndarray
        (N,) float32, 1 for a typical core; 0 where there is no value.
    glare : float
        Part of the cores that are saturated, 0 to 1.
    unreadable : float
        Part of the cores with pixels that are NaN or infinite, 0 to 1.
    """

    values: NDArray[np.float32]
    weights: NDArray[np.float32]
    glare: float
    unreadable: float

    @property
    def grey(self) -> NDArray[np.float32]:
        """Values averaged over the channels, (N,)."""
        grey: NDArray[np.float32] = self.values[:, 0] if self.values.shape[1] == 1 else self.values.mean(axis=1)
        return grey


class CoreSampler:
    """Reduces frames to one value a core: the least-squares amplitude of its profile.

    Parameters
    ----------
    bundle : Bundle
        Of the frames' size, at the place where it is in them.
    levels : Levels
        Of the frames.
    """

    def __init__(self, bundle: Bundle, levels: Levels) -> None:
        count = len(bundle.centres)
        labels = bundle.labels.ravel()
        profile = bundle.transmission.ravel()
        lit = np.flatnonzero((labels < count) & (profile > 0))
        power = np.bincount(labels[lit], profile[lit].astype(np.float64) ** 2, count)
        typical = np.median(power[power > 0]) if (power > 0).any() else 1.0
        weights = np.minimum(power / typical, _MOST_WEIGHT)
        self._weights = np.where(weights > _LEAST_WEIGHT, weights, 0).astype(np.float32)
        share = (profile[lit] ** 2 / np.maximum(power, 1e-9)[labels[lit]]).astype(np.float32)
        self._labels, self._share = labels, np.zeros(labels.size, np.float32)
        self._share[lit] = share
        lit, share = lit[share > _LEAST_SHARE], share[share > _LEAST_SHARE]
        # Pixels in the order of their cores, so that each product reads the frame nearly in order.
        order = np.argsort(labels[lit], kind="stable")
        starts = np.searchsorted(labels[lit[order]], np.arange(count + 1)).astype(np.int32)
        entries = ((share / profile[lit])[order], lit[order].astype(np.int32), starts)
        self._amplitude = csr_array(entries, shape=(count, labels.size))
        self._of_black = np.float32(bundle.black) * np.asarray(self._amplitude.sum(axis=1), dtype=np.float32)[:, None]
        self._scale = 1 / (np.float32(levels.span) * bundle.gains)
        self._offsets = bundle.offsets / (np.float32(levels.span) * bundle.gains)
        self._bright = levels.black + SATURATED * levels.span

    def __call__(self, frame: NDArray[Any]) -> CoreLight:
        """Return the light of the cores in a frame (H, W, C)."""
        height, width, channels = frame.shape
        flat = frame.reshape(height * width, channels)
        scale, offsets = (_per_channel(np.asarray(part, np.float32), channels) for part in (self._scale, self._offsets))
        values = (np.asarray(self._amplitude @ flat.astype(np.float32)) - self._of_black) * scale - offsets
        weights, glare, unreadable = self._weights, 0.0, 0.0
        if not np.isfinite(values).all():
            finite = np.isfinite(values).all(axis=1)
            unreadable = float(1 - finite.mean())
            weights, values = weights * finite, np.where(finite[:, None], values, np.float32(0))
        if not flat.max() < self._bright:  # NaN is not
            bright = np.flatnonzero((flat >= self._bright).any(axis=1) if channels > 1 else flat[:, 0] >= self._bright)
            lost = np.bincount(self._labels[bright], self._share[bright], len(values) + 1)
            hidden = lost[: len(values)] > _MOST_SATURATED
            glare, weights = float(hidden.mean()), weights * ~hidden
        return CoreLight(values, weights, glare, unreadable)


def _per_channel(values: NDArray[np.float32], channels: int) -> NDArray[np.float32]:
    """Return gains or offsets (N, C or 1) for frames of so many channels; their mean where the number differs."""
    return values if values.shape[1] in (1, channels) else values.mean(axis=1, keepdims=True)
