"""The gains of a bundle, measured on from the frames of a live view while it goes on."""

from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.samples import in_grey, sample_cores
from napari_fiberburst.bundle.transmission import with_gains
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.live.background import Background
from napari_fiberburst.live.calibration import burst_of, registered

# Gains are measured by so many frames that show something new, and each time that these have doubled, at most so
# often, by as many of them, evenly taken.
_FRAMES, _MOST_TIMES = 40, 4
# A frame shows something new where its cores differ from those of the last one that did by this part of their contrast.
_LEAST_NEWS = 0.3
# Iterations of registration, and with those of the gains.
_ITERATIONS, _WITH_GAINS = 9, 12
# Gains that were known before are changed where they are off by this much, beside those of so many cores about them
# (1 sigma): the frames themselves tell gains to 0.2 to 1.5 per cent.
_LEAST_OFF, _NEIGHBOURS = 0.015, 40
# A core is taken to pass this part of what those about it pass at least, and so many times as much at most.
_LEAST_GAIN = 0.2
# Registration must keep this part of the frames.
_LEAST_USED = 0.5
# Where gains were off by more than this, frames may have been held by them.
_FAR_OFF = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Better:
    """What was measured on.

    Attributes
    ----------
    bundle : Bundle
        With better gains, of the same cores.
    was_off : bool
        Whether gains were so wrong that they may have held the engine where it was: its scene is worth little then.
    """

    bundle: Bundle
    was_off: bool


class Improving:
    """Keeps some of the frames, and measures the gains of the bundle by them.

    Parameters
    ----------
    black_level, white_level : float or None
        As `Burst` takes them.
    waits : bool
        Whether to return with the better bundle from the frame that completes its frames.
    """

    def __init__(self, black_level: float | None, white_level: float | None, *, waits: bool) -> None:
        self._levels = black_level, white_level
        self._background: Background[Better | None] = Background(waits=waits)
        self._is_outdated = False
        self.forget()

    def forget(self) -> None:
        """Begin anew, with another bundle or other frames."""
        self._frames: list[NDArray[Any]] = []
        self._last: NDArray[np.float32] | None = None
        self._every, self._passed, self._times = 1, 0, 0
        self._is_outdated = self._background.is_busy

    def take(self, bundle: Bundle, pixels: NDArray[Any], light: NDArray[np.float32]) -> Better | None:
        """Take in a frame that was placed, and what its cores show (N,); return a better bundle once there is one."""
        if self._times >= _MOST_TIMES:
            return None
        if self._background.is_busy:
            return self._taken()
        self._keep(pixels, light)
        if len(self._frames) < _FRAMES:
            return None
        self._background.begin(_improving(bundle, self._frames, *self._levels))
        return self._taken()

    def close(self) -> None:
        """Stop what goes on beside the frames."""
        self._background.close()

    def _taken(self) -> Better | None:
        """Return what has come of the frames; where nothing has, half of them make room for others."""
        found = self._background.taken()
        if self._background.is_busy:
            return None
        if self._is_outdated:
            self._is_outdated = False
            return None
        if found is None:
            self._frames = self._frames[_FRAMES // 2 :]
            return None
        self._frames, self._every, self._times = self._frames[1::2], 2 * self._every, self._times + 1
        return found

    def _keep(self, pixels: NDArray[Any], light: NDArray[np.float32]) -> None:
        """Keep a frame where it shows something new, and its turn has come."""
        relative = np.asarray(light / max(float(light.mean()), 1e-6), np.float32)
        if self._last is not None and (relative - self._last).std() < _LEAST_NEWS * relative.std():
            return
        self._last = relative
        self._passed += 1
        if self._passed % self._every == 0:
            self._frames.append(pixels.copy())


def _improving(
    bundle: Bundle, frames: list[NDArray[Any]], black: float | None, white: float | None
) -> Generator[object, None, Better | None]:
    """Measure the gains of a bundle by frames that show it; None where they tell nothing."""
    try:
        better = yield from _registered(bundle, burst_of(frames, black, white))
    except FiberBurstError:
        return None
    if better is None:
        return None
    off = _off(better, bundle)
    if bundle.gains_known and off < _LEAST_OFF:
        return Better(bundle, was_off=False)
    return Better(better, was_off=off > _FAR_OFF)


def _registered(bundle: Bundle, burst: Burst) -> Generator[object, None, Bundle | None]:
    """Register frames and return the bundle with the gains that they have; None where the frames tell nothing.

    Registration finds gains and motion at once, and the gains of the bundle are a prior to it. Where they hold the
    frames nevertheless, it begins again from gains by the mean of the frames.
    """
    for start in (bundle, by_mean(bundle, burst)):
        found = yield from registered(start, burst, _ITERATIONS, _WITH_GAINS)
        if found is not None and found.used.mean() >= _LEAST_USED:
            gains = found.gains / np.median(found.gains)
            return replace(with_gains(start, torch.from_numpy(gains)), gain_weights=bundle.gain_weights)
    return None


def by_mean(bundle: Bundle, burst: Burst) -> Bundle:
    """Return a bundle whose gains are guessed: what cores show on average, relative to those about them."""
    samples = sample_cores(in_grey(torch.from_numpy(burst.frames))[..., None], bundle, burst)
    shown = samples.mean_light
    light = shown.numpy().clip(_LEAST_GAIN * float(shown.median()))
    gains = (light / np.median(light[_neighbours(bundle.centres)], axis=1)).clip(_LEAST_GAIN, 1 / _LEAST_GAIN)
    guessed = with_gains(bundle, torch.from_numpy(gains.astype(np.float32)))
    return replace(guessed, gain_weights=np.zeros_like(bundle.gain_weights))


def _off(better: Bundle, bundle: Bundle) -> float:
    """Return by how much gains differ from what they were, beside those about them, 1 sigma."""
    change = better.brightness / np.maximum(bundle.brightness, 1e-6)
    return float(1.48 * np.median(np.abs(change / np.median(change[_neighbours(bundle.centres)], axis=1) - 1)))


def _neighbours(centres: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the numbers of the cores about each, itself among them, (N, K)."""
    return np.asarray(cKDTree(centres).query(centres, k=min(_NEIGHBOURS, len(centres)))[1], np.intp)
