"""How many frames are behind each pixel of an image: the context of drizzle (Fruchter and Hook, 2002)."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.data.canvas import Canvas

# A sample without a footprint is a frame's pixel, which reaches from its centre to its corners.
_TO_THE_CORNER = math.sqrt(0.5)


def frames_behind(samples: Samples, points: Tensor, used: NDArray[np.bool_], canvas: Canvas) -> NDArray[np.int32]:
    """Return how many frames have a sample that reaches each pixel's centre, (H, W) int32.

    Parameters
    ----------
    samples : Samples
        As the scene was solved from them; those without weight do not count.
    points : Tensor
        (T, N, 2), where they lie, pixels of the reference frame.
    used : numpy.ndarray
        (T,) bool, frames that take part.
    canvas : Canvas
        Of the image.
    """
    radius = _TO_THE_CORNER if samples.radius is None else samples.radius
    device = points.device
    step = torch.from_numpy(canvas.reference_from_image[[0, 1], [0, 1]]).to(device)
    first = torch.from_numpy(canvas.reference_from_image[:2, 2]).to(device)
    height, width = canvas.shape
    across, down = (radius / step).tolist()
    below = torch.arange(math.floor(2 * down) + 1, device=device)[:, None]
    count = torch.zeros(height, width, dtype=torch.int32, device=device)
    for number in np.flatnonzero(used):
        places = (points[number, samples.weights[number] > 0].double() - first) / step
        x, y = places[torch.isfinite(places).all(dim=1)].unbind(dim=1)
        # A disc is one run of pixels in each row, so its ends are enough.
        row = (y - down).ceil() + below
        half = across * (1 - ((row - y) / down).square()).clamp_min(0).sqrt()
        start, stop = (x - half).ceil().clamp(0, width), ((x + half).floor() + 1).clamp(0, width)
        reached = (start < stop) & (row >= 0) & (row < height) & ((row - y).abs() <= down)
        row, start, stop = (part[reached].long() for part in (row, start, stop))
        ends = (row * (width + 1) + end for end in (start, stop))
        begun, ended = (torch.bincount(end, minlength=height * (width + 1)) for end in ends)
        count += (begun - ended).reshape(height, width + 1)[:, :width].cumsum(dim=1) > 0
    array: NDArray[np.int32] = count.cpu().numpy()
    return array
