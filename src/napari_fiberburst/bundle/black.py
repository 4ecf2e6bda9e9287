"""The black level of frames that show no black: the light between cores is told from none by how it goes with theirs.

Where a bundle fills the frame, its darkest pixels lie between cores. In some bundles they are black, and show the
level of the camera. In others, the cores' own light spreads there, which rises and falls with that of the cores about
them. A line through many such pixels, the light of each over that about it, tells the two apart.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.operators.filters import local_mean

# The light about a pixel is averaged over so many pitches (Gaussian); and so many pitches are its neighbourhood.
_ABOUT, _NEIGHBOURHOOD = 0.7, 3.0
# This part of the lit pixels, the darkest beside those about them, lies between cores; so many of them tell, in so
# many frames, spread over all.
_BETWEEN, _MOST_PIXELS, _MOST_FRAMES = 0.05, 4000, 6
# Places with less than this part of a bright place's light are not lit.
_LIT = 0.1
# Residuals beyond so many of their median count less (Huber), in so many rounds.
_ROBUST, _ROUNDS = 2.5, 4
# Where so much of the light goes with that of the cores, the level cannot be told from the rest.
_MOST_SPREAD = 0.85


def black_between_cores(frames: Tensor, pitch: float) -> float | None:
    """Return the intensity without light in frames (T, H, W), full scale 1; None where they do not tell it.

    Parameters
    ----------
    frames : Tensor
        In [0, 1], that the bundle fills.
    pitch : float
        Of its cores, pixels.
    """
    chosen = np.unique(np.linspace(0, len(frames) - 1, _MOST_FRAMES).round().astype(int))
    mean = frames.mean(dim=0)
    about = local_mean(mean, _NEIGHBOURHOOD * pitch)
    y, x = (about > _LIT * about.max()).nonzero().unbind(dim=1)
    relative = (mean[y, x] / about[y, x]).cpu().numpy()
    between = np.flatnonzero(relative <= np.quantile(relative, _BETWEEN))
    between = between[:: max(1, len(between) // _MOST_PIXELS)]
    y, x = (part.cpu()[torch.from_numpy(between)].to(frames.device) for part in (y, x))
    light, nearby = [], []
    for number in chosen.tolist():
        light.append(frames[number, y, x].double().cpu().numpy())
        nearby.append(local_mean(frames[number], _ABOUT * pitch)[y, x].double().cpu().numpy())
    height, slope = _line(np.concatenate(nearby), np.concatenate(light))
    # The light about a pixel has the level in it, too.
    return height / (1 - slope) if slope < _MOST_SPREAD else None


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Return height and slope of a robust line through points."""
    weights = np.ones_like(x)
    for _ in range(_ROUNDS):
        middle_x, middle_y = np.average(x, weights=weights), np.average(y, weights=weights)
        spread = np.sum(weights * (x - middle_x) ** 2)
        slope = float(np.sum(weights * (x - middle_x) * (y - middle_y)) / spread) if spread > 0 else 0.0
        height = float(middle_y - slope * middle_x)
        left = np.abs(y - height - slope * x)
        weights = np.minimum(_ROBUST * np.median(left) / np.maximum(left, 1e-12), 1.0) + 1e-12
    return height, slope
