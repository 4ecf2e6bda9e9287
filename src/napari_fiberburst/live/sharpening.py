"""The footprint undone: from the scene as cores see it to a picture over the pixels of a frame.

Of a wave of frequency f, c samples to a node and a footprint's response B let a scene solved with both have the part
c B / (c B^2 + lambda Q), with Q the thin plate prior. What the memory has solved, with the membrane P at the weight mu,
has c / (c + mu P) of it as cores see it: the quotient, and the shift by a part of a pixel that brings nodes onto the
frame's pixels, is one filter.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2

from napari_fiberburst.live.memory import TIE, Memory
from napari_fiberburst.live.pose import Pose
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.operators.priors import MEMBRANE, THIN_PLATE

# lambda, in samples of weight 1 to a pixel.
_SMOOTHNESS = 0.01
# The filter is made anew where the density has changed by more than this part.
_CHANGED = 0.1
# Pixels: turn and zoom that move no corner farther are left out.
_LEAST_TURN = 0.3


class Sharpener:
    """Makes pictures of a memory.

    Parameters
    ----------
    memory : Memory
        Of the size that it will keep.
    radius : float
        Of a core's footprint, pixels.
    """

    def __init__(self, memory: Memory, radius: float) -> None:
        rows, columns = memory.nodes.rows, memory.nodes.columns
        self._along_y, self._along_x = torch.fft.fftfreq(rows), torch.fft.rfftfreq(columns)
        footprint = Footprint(Grid(0.0, 0.0, 1.0, (rows, columns)), radius, torch.device("cpu"))
        self._passed = footprint.transfer(self._along_y, self._along_x)
        self._density, self._filter = 0.0, np.ones((rows, columns // 2 + 1), np.float32)

    def __call__(self, memory: Memory, pose: Pose, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return the picture over the pixels of a frame (height, width) that lies so, (H, W, C)."""
        self._follow(memory.density)
        scene, nodes = memory.scene.numpy(), memory.nodes
        first = pose.place - pose.middle - complex(nodes.x0, nodes.y0)
        is_turned = pose.corner_motion() > _LEAST_TURN
        whole = complex(round(first.real), round(first.imag))
        response = self._filter if is_turned else self._filter * self._shifted(first - whole)
        spectra = rfft2(scene, axes=(1, 2)) * response
        pictures = irfft2(spectra, s=(nodes.rows, nodes.columns), axes=(1, 2))
        if is_turned:
            return _turned(pictures, pose, complex(nodes.x0, nodes.y0), shape)
        top, left = int(whole.imag), int(whole.real)
        shown: NDArray[np.float32] = np.moveaxis(pictures[:, top : top + shape[0], left : left + shape[1]], 0, -1)
        return shown

    def _follow(self, density: float) -> None:
        """Make the filter for this density of samples, where the one there is is of another."""
        if abs(density - self._density) <= _CHANGED * self._density:
            return
        self._density = density
        plate, tied = (prior.response(self._along_y, self._along_x) for prior in (THIN_PLATE, MEMBRANE))
        wanted = density * self._passed / (density * self._passed**2 + _SMOOTHNESS * plate)
        self._filter = (wanted * (1 + TIE * tied / density)).numpy()

    def _shifted(self, part: complex) -> NDArray[np.complex64]:
        """Return the filter that moves images up and left by parts of a pixel, x + i y."""
        along_y, along_x = (
            np.exp(2j * np.pi * frequency.numpy() * by).astype(np.complex64)
            for frequency, by in ((self._along_y, part.imag), (self._along_x, part.real))
        )
        shifted: NDArray[np.complex64] = along_y[:, None] * along_x
        return shifted


def _turned(pictures: NDArray[np.float32], pose: Pose, origin: complex, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return pictures (C, rows, columns), whose first node lies at `origin`, over the pixels of a turned frame."""
    rows, columns = pictures.shape[1:]
    (height, width), turn = shape, pose.turn
    place = pose.place - origin
    # As torch counts: from -1 to 1 over the nodes, and over the pixels.
    across, down = width - 1, height - 1
    theta = [
        [turn.real * across / (columns - 1), -turn.imag * down / (columns - 1), 2 * place.real / (columns - 1) - 1],
        [turn.imag * across / (rows - 1), turn.real * down / (rows - 1), 2 * place.imag / (rows - 1) - 1],
    ]
    images, size = torch.from_numpy(pictures)[None], [1, len(pictures), height, width]
    grid = torch.nn.functional.affine_grid(torch.tensor([theta]), size, align_corners=True)
    drawn = torch.nn.functional.grid_sample(images, grid, mode="bicubic", padding_mode="border", align_corners=True)
    turned: NDArray[np.float32] = drawn[0].movedim(0, -1).numpy()
    return turned
