"""Homographies: 3x3 matrices named by direction (``scene_from_frame``), acting on points (x, y)."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def apply(target_from_source: Tensor, points: Tensor) -> Tensor:
    """Map points by homographies.

    Parameters
    ----------
    target_from_source : Tensor
        (..., 3, 3); its leading axes broadcast against those of `points`.
    points : Tensor
        (..., 2) as (x, y).

    Returns
    -------
    Tensor
        (..., 2); infinite where a point maps to the line at infinity.
    """
    x, y = points[..., 0], points[..., 1]
    # Sums of products rather than matmul: for millions of 3x3 matrices it is several times faster.
    mapped = [
        target_from_source[..., row, 0] * x + target_from_source[..., row, 1] * y + target_from_source[..., row, 2]
        for row in range(3)
    ]
    return torch.stack([mapped[0] / mapped[2], mapped[1] / mapped[2]], dim=-1)


def relative_to_first(scene_from_frame: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return homographies (T, 3, 3) from each frame to frame 0, bottom right element 1; [0] is the identity.

    The others are NaN where frame 0 sees the scene edge on, so that nothing can be said in its pixels.
    """
    try:
        frame0_from_frame: NDArray[np.float64] = np.linalg.inv(scene_from_frame[0]) @ scene_from_frame
    except np.linalg.LinAlgError:
        frame0_from_frame = np.full_like(scene_from_frame, np.nan)
    frame0_from_frame[0] = np.eye(3)
    with np.errstate(divide="ignore", invalid="ignore"):
        return frame0_from_frame / frame0_from_frame[:, 2:, 2:]
