"""The footprint undone: from the scene as cores see it to a picture over the pixels of a frame.

Of a wave of frequency f, c samples to a pixel and a footprint's response B let a scene solved with both have the part
c B / (c B^2 + lambda Q), with Q the thin plate prior. The memory has solved a linear spline instead, with the membrane
P at the weight mu: of the wave as cores see it, it has c / (c + mu P), at nodes that stand out by h / m, with h the
response of the spline between nodes, and m that of h and all its aliases, squared. The quotient, and the shift by a
part of a pixel that brings the picture onto the frame's pixels, is one filter. The picture has the waves of the nodes
on more places.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import ifft, irfft, rfft2
from torch import Tensor

from napari_fiberburst.live.compiled import compiled
from napari_fiberburst.live.memory import TIE, Memory
from napari_fiberburst.live.pose import Pose
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.operators.priors import MEMBRANE, THIN_PLATE

Floats = NDArray[np.float32]
Waves = NDArray[np.complex64]

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
        nodes = memory.nodes
        self._pixels = round(nodes.rows * nodes.spacing), round(nodes.columns * nodes.spacing)
        # Waves over the field that nodes can show, without the shortest.
        self._rows = np.r_[: nodes.rows // 2, 1 - nodes.rows // 2 : 0]
        self._columns = np.arange(nodes.columns // 2)
        along_y, along_x = (torch.from_numpy(part) for part in self._frequencies)
        footprint = Footprint(Grid(0.0, 0.0, 1.0, self._pixels), radius, torch.device("cpu"))
        self._passed = footprint.transfer(along_y, along_x)
        self._plate = THIN_PLATE.response(along_y, along_x)
        self._lower, stiffness = _spline(along_y * nodes.spacing, along_x * nodes.spacing)
        self._tied = stiffness / nodes.spacing**2
        self._per_node = nodes.spacing**2
        self._density, self._filter = 0.0, np.ones((len(self._rows), len(self._columns)), np.float32)
        self._spectrum = np.zeros((self._pixels[0], len(self._columns)), np.complex64)

    def __call__(self, memory: Memory, pose: Pose, gain: float, ground: Floats) -> Floats:
        """Return the picture over the pixels of a frame that lies so, (H, W, C).

        Parameters
        ----------
        memory : Memory
            What there is to be seen.
        pose : Pose
            Of the frame.
        gain : float
            Intensities for a full scale of light.
        ground : numpy.ndarray
            (H, W) float32, intensities without light; NaN where nothing is drawn.
        """
        self._follow(memory.density)
        first = pose.place - pose.middle - memory.nodes.origin
        is_turned = pose.corner_motion() > _LEAST_TURN
        whole = 0j if is_turned else complex(round(first.real), round(first.imag))
        along_y, along_x = self._shift(0j if is_turned else first - whole)
        height = self._pixels[0] if is_turned else ground.shape[0]
        top, left = int(whole.imag), int(whole.real)
        image = np.empty((len(memory.scene), *ground.shape), np.float32)
        for channel, scene in enumerate(memory.scene):
            _filtered(rfft2(scene), self._filter, along_y, along_x, self._spectrum)
            lines = ifft(self._spectrum, axis=0)[top : top + height]
            picture = irfft(lines, self._pixels[1], axis=1)
            if is_turned:
                picture = _turned(picture, pose, memory.nodes.origin, ground.shape)
            _finish(picture, left, np.float32(gain), ground, image[channel])
        return np.moveaxis(image, 0, -1)

    def _follow(self, density: float) -> None:
        """Make the filter for this density of samples, where the one there is is of another."""
        if abs(density - self._density) <= _CHANGED * self._density:
            return
        self._density = density
        wanted = density * self._passed / (density * self._passed**2 + _SMOOTHNESS * self._plate)
        drawn = wanted * self._lower * (1 + TIE * self._tied / density) * self._per_node
        self._filter = drawn.to(torch.float32).numpy()

    @property
    def _frequencies(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Of the waves along y and along x, cycles per pixel."""
        height, width = self._pixels
        return (self._rows / height).astype(np.float32), (self._columns / width).astype(np.float32)

    def _shift(self, part: complex) -> tuple[Waves, Waves]:
        """Return filters along y and along x that move an image up and left by parts of a pixel, x + i y."""
        along_y, along_x = self._frequencies
        shift_y, shift_x = (
            np.exp(2j * np.pi * along * by).astype(np.complex64)
            for along, by in ((along_y, part.imag), (along_x, part.real))
        )
        return shift_y, shift_x


def _spline(along_y: Tensor, along_x: Tensor) -> tuple[Tensor, Tensor]:
    """Return how much lower waves are between nodes than at them, and the membrane beside one sample a node.

    Parameters
    ----------
    along_y, along_x : Tensor
        (Fy,) and (Fx,), cycles per node.
    """
    between_y, between_x = torch.sinc(along_y) ** 2, torch.sinc(along_x) ** 2
    sampled_y, sampled_x = ((2 + torch.cos(2 * torch.pi * along)) / 3 for along in (along_y, along_x))
    sampled, between = sampled_y[:, None] * sampled_x, between_y[:, None] * between_x
    return sampled / between, MEMBRANE.response(along_y, along_x) / sampled


@compiled("void(c8[:,::1], f4[:,::1], c8[::1], c8[::1], c8[:,::1])")
def _filtered(waves: Waves, response: Floats, along_y: Waves, along_x: Waves, spectrum: Waves) -> None:
    """Put waves (rows, ...) into a spectrum of more rows, each times its response and shift; those missing are 0."""
    rows, columns = response.shape
    half = (rows + 1) // 2
    spectrum[half : spectrum.shape[0] - half + 1] = 0
    for row in range(rows):
        up = rows - row if row >= half else 0  # rows from the end
        there, here = (waves[len(waves) - up], spectrum[len(spectrum) - up]) if up else (waves[row], spectrum[row])
        by, passed = along_y[row], response[row]
        for column in range(columns):
            here[column] = there[column] * (by * along_x[column]) * passed[column]


@compiled("void(f4[:,::1], i8, f4, f4[:,::1], f4[:,::1])")
def _finish(picture: Floats, left: int, gain: Any, ground: Floats, image: Floats) -> None:
    """Put the columns of a picture from `left` on into an image, as intensities."""
    rows, columns = ground.shape
    for row in range(rows):
        for column in range(columns):
            image[row, column] = picture[row, left + column] * gain + ground[row, column]


def _turned(picture: Floats, pose: Pose, origin: complex, shape: tuple[int, ...]) -> Floats:
    """Return a picture, whose first pixel lies at `origin`, over the pixels of a turned frame (height, width)."""
    rows, columns = picture.shape
    (height, width), turn = shape, pose.turn
    place = pose.place - origin
    # As torch counts: from -1 to 1 over the picture, and over the frame.
    across, down = width - 1, height - 1
    theta = [
        [turn.real * across / (columns - 1), -turn.imag * down / (columns - 1), 2 * place.real / (columns - 1) - 1],
        [turn.imag * across / (rows - 1), turn.real * down / (rows - 1), 2 * place.imag / (rows - 1) - 1],
    ]
    images, size = torch.from_numpy(picture)[None, None], [1, 1, height, width]
    grid = torch.nn.functional.affine_grid(torch.tensor([theta]), size, align_corners=True)
    drawn = torch.nn.functional.grid_sample(images, grid, mode="bicubic", padding_mode="border", align_corners=True)
    turned: Floats = drawn[0, 0].numpy()
    return turned
