"""Weighted statistics of rows: of frames or pairs, each with a weight for every sample."""

import torch
from torch import Tensor


def mean(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted mean of each row (n, N), (n, 1); 0 where nothing has weight."""
    return (weights * values).sum(dim=1, keepdim=True) / weights.sum(dim=1, keepdim=True).clamp_min(1e-9)


def rms(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted root mean square of each row (n, N), (n, 1); never quite 0."""
    return mean(values.square(), weights).sqrt().clamp_min(1e-6)


def correlation(first: Tensor, second: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted correlation of rows (n, N), (n,); 0 where there is nothing to compare."""
    first, second = (part - mean(part, weights) for part in (first, second))
    power = (weights * first.square()).sum(dim=1) * (weights * second.square()).sum(dim=1)
    return torch.where(power > 0, (weights * first * second).sum(dim=1) / power.clamp_min(1e-20).sqrt(), 0.0)
