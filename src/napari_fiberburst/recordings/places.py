"""Places of a recording, each counted once however long the probe has rested there.

The mean of what a core has seen on a wide path is its gain. Were every frame to count alike, a probe that rests for
half of a recording would leave the object in that mean, and all frames would be drawn to where it rested.
"""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# How different frames are is told by so many of them, spread over the recording.
_TOLD_BY = 48
# The quantiles that stand for frames of two places, and for frames in a row of a probe at rest.
_FAR, _NEAR = 0.9, 0.1
# A frame shows another place where it differs from the first of the last one by this part of the way between the two.
_ELSEWHERE = 0.5

# Gives what cores have seen in a frame, by its number, and their weights, each (N,).
Light = Callable[[int], tuple[Tensor, Tensor]]


def mean_over_places(light: Light, frames: NDArray[np.int64]) -> Tensor:
    """Return what each core has seen (N,), in the mean over the places that frames (T,) of these numbers show."""
    total = mass = torch.zeros_like(light(0)[0])
    for place in _places(light, frames):
        seen = weight = torch.zeros_like(total)
        for number in place:
            values, weights = light(number)
            seen, weight = seen + values * weights, weight + weights
        total = total + seen / weight.clamp_min(1e-9)
        mass = mass + (weight > 0)
    return total / mass.clamp_min(1)


def _places(light: Light, frames: NDArray[np.int64]) -> Iterator[list[int]]:
    """Return frames in a row that show about the same place, place by place."""
    limit = _different_enough(light, frames)
    place: list[int] = []
    first = None
    for number in frames.tolist():
        seen = _relative(*light(number))
        if first is not None and _difference(first, seen) <= limit:
            place.append(number)
            continue
        if place:
            yield place
        place, first = [number], seen
    if place:
        yield place


def _different_enough(light: Light, frames: NDArray[np.int64]) -> float:
    """Return by how much frames of two places differ: halfway between frames in a row and frames far apart."""
    if len(frames) < 3:
        return 0.0
    told = np.unique(np.linspace(0, len(frames) - 2, _TOLD_BY).astype(int))
    seen, later = ([_relative(*light(int(frames[at]))) for at in some] for some in (told, told + 1))
    far = [_difference(one, other) for number, one in enumerate(seen) for other in seen[:number]]
    near = [_difference(one, other) for one, other in zip(seen, later, strict=True)]
    least = float(np.quantile(near, _NEAR))
    return least + _ELSEWHERE * max(float(np.quantile(far or near, _FAR)) - least, 0.0)


def _relative(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return what cores have seen relative to their mean, because the light may flicker."""
    mean = (values * weights).sum() / weights.sum().clamp_min(1e-9)
    return values / mean.clamp_min(1e-9), weights


def _difference(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor]) -> float:
    weights = one[1] * other[1]
    return float((weights * (one[0] - other[0]).square()).sum() / weights.sum().clamp_min(1e-9))
