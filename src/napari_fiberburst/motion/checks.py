"""What frames are good for: small questions about a burst and its registration."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import SATURATED
from napari_fiberburst.motion.joint import Groupwise

# Frames that vary less than this part of what is usual are black, white or otherwise empty.
_LEAST_SPREAD = 0.2


def exposed(frames: Tensor) -> Tensor:
    """Return which frames (T, H, W) show something: not all black, white or even; all of them where none does."""
    spread = frames.std(dim=(1, 2))
    bright = (frames >= SATURATED).float().mean(dim=(1, 2))
    good = (spread > _LEAST_SPREAD * spread.median()) & (bright < 0.5)
    return good if bool(good.any()) else torch.ones_like(good)


def contrast(values: Tensor) -> float:
    """Return how much the light of cores (T, N) changes from frame to frame, in parts of its mean."""
    spread = values.std(dim=0) / values.mean(dim=0).abs().clamp_min(1e-6)
    return float(spread.median())


def travel(homographies: NDArray[np.float64], shape: tuple[int, int]) -> float:
    """Return how far the frames' corners lie from where they are on average, root mean square, pixels."""
    height, width = shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], dtype=np.float64)
    mapped = corners @ homographies.transpose(0, 2, 1)
    places = mapped[..., :2] / mapped[..., 2:]
    return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=2).mean()))


def fitness(group: Groupwise, used: NDArray[np.bool_]) -> Tensor:
    """Return how much each frame should count by how well it fits, (T,): a blurred one fits badly and counts less."""
    left = (group.values - group.predicted()).square() * group.weights
    error = (left.sum(dim=1) / group.weights.sum(dim=1).clamp_min(1e-9)).cpu().numpy()
    usual = np.median(error[used])
    return torch.from_numpy(np.clip(usual / np.maximum(error, 1e-12), 0, 1)).to(group.weights)
