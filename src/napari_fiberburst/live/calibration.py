"""An engine without a bundle takes one from the first frames that differ."""

from collections.abc import Generator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.calibrate import calibrating, with_even_gains
from napari_fiberburst.bundle.field import find_marks
from napari_fiberburst.bundle.noise import measure_noise
from napari_fiberburst.bundle.pitch import find_pitch
from napari_fiberburst.bundle.samples import Samples, in_grey, only_exposed, sample_cores
from napari_fiberburst.bundle.transmission import with_gains
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.live.background import Background
from napari_fiberburst.motion.register import refining, registering
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.motion.trust import MOST_UNEXPLAINED, unexplained_part
from napari_fiberburst.pipeline.reconstruct import iterate
from napari_fiberburst.pipeline.remeasure import remeasured
from napari_fiberburst.settings import choose

# So many frames calibrate, spread over so many seconds at least where times are known: a fast camera's first twenty
# would hardly differ.
CALIBRATED_BY, _SECONDS = 20, 1.0
# Iterations of registration, and with those of the gains. `reconstruct` takes about 18 and 23 of them; with the gains
# that are known after these the picture is 0.5 to 1.5 dB worse.
_ITERATIONS, _WITH_GAINS = 7, 10
# Degrees of freedom of frames: what the engine follows.
_DOF = 4
# Until there is a bundle, frames are shown through a Gaussian of so many pitches, which leaves no honeycomb.
_BLUR = 0.7


def frames_needed(rate: float) -> int:
    """Return how many frames go by until they are enough for a bundle, at so many frames a second."""
    return max(CALIBRATED_BY, int(np.ceil(_SECONDS * rate)) + 1)


class Calibration:
    """Gathers frames until a bundle can be made of them, and tries again with as many more where it cannot.

    Parameters
    ----------
    black_level, white_level : float or None
        As `Burst` takes them.
    waits : bool
        Whether to return with the bundle from the frame that completes it; otherwise it is made beside the frames.
    """

    def __init__(self, black_level: float | None, white_level: float | None, *, waits: bool) -> None:
        self._levels = black_level, white_level
        self._frames: list[NDArray[Any]] = []
        self._since = 0.0
        self._background: Background[Bundle | None] = Background(waits=waits)
        self._pitch: float | None = None
        self._has_looked = False

    def take(self, pixels: NDArray[Any], seconds: float | None) -> Bundle | None:
        """Take in a frame (H, W) or (H, W, C) and when it was taken; return the bundle once there is one."""
        if self._background.is_busy:
            return self._background.taken()
        if seconds is not None:
            if not self._frames or seconds < self._since:  # clocks are set back
                self._frames, self._since = [], seconds
            if seconds - self._since < len(self._frames) * _SECONDS / (CALIBRATED_BY - 1) - 1e-6:
                return None
        self._frames.append(pixels.copy())
        if len(self._frames) < CALIBRATED_BY:
            return None
        frames, self._frames = self._frames, []
        self._background.begin(_calibrating(frames, *self._levels))
        return self._background.taken()

    def picture(self, pixels: NDArray[Any]) -> NDArray[np.float32]:
        """Return a frame, float32, blurred so that it has no honeycomb; as it came where the first one shows none."""
        if not self._has_looked:
            self._has_looked = True
            self._pitch = _pitch_of(pixels)
        image = pixels.astype(np.float32)
        if self._pitch is None:
            return image
        sigma = _BLUR * self._pitch
        blurred: NDArray[np.float32] = gaussian_filter(image, (sigma, sigma, 0)[: image.ndim])
        return blurred

    def close(self) -> None:
        """Stop what goes on beside the frames."""
        self._background.close()


def _pitch_of(pixels: NDArray[Any]) -> float | None:
    """Return the pitch of the bundle that one frame shows, pixels; None where it shows none."""
    grey = np.nan_to_num(pixels.reshape(*pixels.shape[:2], -1).mean(axis=2, dtype=np.float32), posinf=0, neginf=0)
    low, high = float(grey.min()), float(grey.max())
    return find_pitch(torch.from_numpy((grey - low) / (high - low))) if high > low else None


def _calibrating(
    frames: list[NDArray[Any]], black: float | None, white: float | None
) -> Generator[object, None, Bundle | None]:
    """Make a bundle of frames; None where nothing is to be seen yet, and the next ones may show more."""
    try:
        return (yield from measuring(burst_of(frames, black, white)))
    except FiberBurstError:
        return None


def burst_of(frames: list[NDArray[Any]], black: float | None, white: float | None) -> Burst:
    """Return frames (H, W) or (H, W, C) as a burst."""
    return Burst(np.stack(frames), axes="TYXC"[: frames[0].ndim + 1], black_level=black, white_level=white)


def measuring(burst: Burst) -> Generator[object, None, Bundle]:
    """Measure the bundle of a burst as `reconstruct` does, but for all that an image alone needs.

    The mean of the frames alone would hold the object for gain, and the frames still. So they are registered, and the
    transmission and the gains are measured by what other cores have seen at the same places. Where the frames do not
    agree after that, `reconstruct` itself has to do.
    """
    grey = in_grey(torch.from_numpy(burst.frames))
    bundle = yield from calibrating(grey, burst, find_marks(only_exposed(grey)))
    samples = sample_cores(grey[..., None], bundle, burst)
    registration = yield from registering(samples, dof=_DOF, bends=False, noise=0.0, iterations=_ITERATIONS, seed=0)
    if registration.is_still:
        return with_even_gains(bundle)
    bundle, registration = remeasured(bundle, registration, grey, burst)
    yield None
    samples = sample_cores(grey[..., None], bundle, burst)
    registration = yield from refining(samples, registration, dof=_DOF, iterations=_WITH_GAINS, seed=0)
    if not _agrees(registration, samples, bundle, burst):
        known = (yield from iterate(burst, choose("auto"))).bundle
        return bundle if known is None else known
    return with_gains(bundle, torch.from_numpy(registration.gains))


def registered(
    bundle: Bundle, burst: Burst, iterations: int, with_gains: int
) -> Generator[object, None, Registration | None]:
    """Register frames behind a bundle and find its gains, in so many iterations; None where they rest or disagree."""
    samples = sample_cores(in_grey(torch.from_numpy(burst.frames))[..., None], bundle, burst)
    found = yield from registering(samples, dof=_DOF, bends=False, noise=0.0, iterations=iterations, seed=0)
    if found.is_still:
        return None
    found = yield from refining(samples, found, dof=_DOF, iterations=with_gains, seed=0)
    return found if _agrees(found, samples, bundle, burst) else None


def _agrees(registration: Registration, samples: Samples, bundle: Bundle, burst: Burst) -> bool:
    """Whether the frames agree on a scene."""
    noise = measure_noise(in_grey(torch.from_numpy(burst.frames)), bundle, burst, samples)
    variance = torch.zeros(1) if noise is None else noise.of_samples(bundle, burst, samples)[samples.weights > 0]
    return unexplained_part(registration, samples, float(variance.median()) ** 0.5) <= MOST_UNEXPLAINED
