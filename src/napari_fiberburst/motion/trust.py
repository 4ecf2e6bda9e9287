"""How far a registration is to be trusted: frame by frame, and in whole."""

import logging
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.motion.coarse import LEAST_CONFIDENCE, confidence
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.operators import steady

logger = logging.getLogger(__name__)

# Root mean square over the corners, in pitches: frames that move less do not fill the gaps between cores.
_LEAST_MOTION = 0.25
# A frame that agrees with the others less than this part of the median frame is left out.
_LEAST_OF_USUAL = 0.6
# A registration that leaves more unexplained than this has failed, or the model is wrong. Of simulated bursts those
# that are registered to some tenths of a pixel leave up to 0.2 without noise, and those that are not 0.26 and more.
MOST_UNEXPLAINED = 0.22
# Frames that are brighter or darker than the median frame by more than this factor do not stand for the others.
_BRIGHTNESS = 2.0


def _evened(found: Registration, samples: Samples) -> Tensor:
    """Return grey values at gains and exposures of 1, (T, N)."""
    gains, exposures = (torch.from_numpy(part).to(samples.values) for part in (found.gains, found.exposures))
    return samples.grey / (exposures[:, None] * gains[samples.core_index])


def unexplained_part(found: Registration, samples: Samples, noise: float) -> float:
    """Return what part of the samples' change from frame to frame is left, as a ratio of root mean squares."""
    samples = samples.weighted(torch.from_numpy(found.used))
    values, weights = _evened(found, samples), samples.weights
    mean = (weights * values).sum(dim=0) / weights.sum(dim=0).clamp_min(1e-9)
    change = float(steady.weighted_mean((values - mean).square(), weights))
    left = max(found.residual**2 - noise**2, 0.0)
    return float(np.sqrt(left / max(change - noise**2, left, 1e-12)))


def judged(found: Registration, samples: Samples) -> Registration:
    """Ask how far each frame is to be trusted, leave out those that are not, and see whether they move at all."""
    shows = samples.weights.any(dim=1).cpu().numpy()
    samples = samples.weighted(torch.from_numpy(found.used))
    agreement = confidence(samples.positions, _evened(found, samples), samples.weights, found.motion, samples.pitch)
    trust = np.where(found.used, np.clip(agreement, 0, 1), 0.0)
    used = found.used & (trust >= max(LEAST_CONFIDENCE, _LEAST_OF_USUAL * np.median(trust[found.used])))
    known = np.where(shows, trust, np.nan)
    found = replace(found, used=used, confidence=known, frame_weights=used.astype(np.float32))
    if used.sum() < 2:
        return found
    for left_out, which in (
        (~shows, "frames that show nothing new, because they are black, over-exposed or copies,"),
        (shows & ~used, "frames that could not be registered"),
    ):
        if left_out.any():
            numbers = ", ".join(str(number) for number in np.flatnonzero(left_out))
            found = _noted(found, f"{which} are left out: {numbers}")
    travel = _travel(found.reference_from_frame[used], samples.shape)
    return replace(found, travel=travel, is_still=bool(travel < _LEAST_MOTION * samples.pitch))


def still(found: Registration) -> Registration:
    """Return a registration whose frames all look at the same place."""
    return replace(found, is_still=True, stage="complete", gains=np.ones_like(found.gains))


def alone(found: Registration, samples: Samples) -> Registration:
    """Return a registration of one frame: the first that is about as bright as most of those that show anything."""
    if len(found.used) > 1:
        found = _noted(
            found, "the frames could not be registered to one another; the image is made of one of them alone"
        )
    brightness, shows = samples.grey.mean(dim=1).cpu().numpy(), samples.weights.any(dim=1).cpu().numpy()
    usual = np.median(brightness[shows]) if shows.any() else 0.0
    is_usual = shows & (brightness >= usual / _BRIGHTNESS) & (brightness <= usual * _BRIGHTNESS)
    used = np.arange(len(found.used)) == int(np.argmax(is_usual))
    return still(replace(found, used=used, frame_weights=used.astype(np.float32)))


def _travel(homographies: NDArray[np.float64], shape: tuple[int, int]) -> float:
    """Return how far the frames' corners lie from where they are on average, root mean square, pixels."""
    height, width = shape
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], dtype=np.float64)
    places = transform_points(homographies, corners)
    return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=2).mean()))


def _noted(found: Registration, text: str) -> Registration:
    logger.warning(text)
    return replace(found, notes=(*found.notes, text))
