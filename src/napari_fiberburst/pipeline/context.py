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
    across, down = (math.ceil(radius / size) + 1 for size in step.tolist())
    around = torch.cartesian_prod(torch.arange(-across, across + 1), torch.arange(-down, down + 1)).to(device)
    count = torch.zeros(height * width, dtype=torch.int32, device=device)
    for number in np.flatnonzero(used):
        places = (points[number, samples.weights[number] > 0].double() - first) / step
        places = places[torch.isfinite(places).all(dim=1)]
        nearest = places.round()
        seen = torch.zeros(height * width, dtype=torch.bool, device=device)
        for offset in around:
            pixel = nearest + offset
            reached = ((pixel - places) * step).norm(dim=1) <= radius
            reached &= ((pixel >= 0) & (pixel < pixel.new_tensor([width, height]))).all(dim=1)
            column, row = pixel[reached].long().unbind(dim=1)
            seen[row * width + column] = True
        count += seen
    array: NDArray[np.int32] = count.reshape(height, width).cpu().numpy()
    return array
