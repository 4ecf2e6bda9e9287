"""The area over which a core gathers light, as a filter of the scene."""

import math
from functools import lru_cache

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from napari_fiberburst.operators import steady
from napari_fiberburst.operators.grid import Grid

# The rim of the disc is this soft, pixels, and drawn with this many points a node.
_EDGE = 0.3
_SUBSAMPLES = 5
# Images of more nodes than the second number are filtered in parts whose transforms have this side: these stay in the
# processor's cache.
_SIDE, _LARGE = 360, 2_000_000


class Footprint:
    """Filter images on a grid by a disc: each node becomes the mean of the scene about it.

    Cores are round and the scene's scale hardly differs between frames, so one filter of the scene stands for all
    footprints, and a core is one point in the filtered scene. The filter is symmetric, so it is its own adjoint.

    Parameters
    ----------
    grid : Grid
        Where the images live; outside, they are 0.
    radius : float
        Of the disc, pixels.
    device : torch.device
        Where the images are.
    """

    def __init__(self, grid: Grid, radius: float, device: torch.device) -> None:
        kernel = disc(radius / grid.spacing, _EDGE / grid.spacing)
        reach = kernel.shape[0] // 2
        self._shape, self._reach = grid.shape, reach
        self._is_large = grid.shape[0] * grid.shape[1] > _LARGE
        side = max(_SIDE, int(next_fast_len(8 * reach, real=True)))
        whole = tuple(int(next_fast_len(side + reach, real=True)) for side in grid.shape)
        self._padded = (side, side) if self._is_large else whole
        centred = torch.zeros(self._padded)
        centred[: kernel.shape[0], : kernel.shape[1]] = kernel
        centred = torch.roll(centred, (-reach, -reach), (0, 1))
        self._response = torch.fft.rfft2(centred).real.to(device)
        self._kernel = kernel
        self.power = float(kernel.square().sum())

    @staticmethod
    @lru_cache(maxsize=8)
    def cached(grid: Grid, radius: float, device: torch.device) -> "Footprint":
        """Return a footprint, the same one for the same arguments: its response is worth keeping."""
        return Footprint(grid, radius, device)

    def __call__(self, images: Tensor) -> Tensor:
        """Return the filtered images, (..., H, W)."""
        if not self._is_large:
            return self._filtered(images)[..., : self._shape[0], : self._shape[1]]
        filtered = torch.empty_like(images)
        own = self._padded[0] - 2 * self._reach
        about = torch.nn.functional.pad(images, [self._reach] * 4)
        for top in range(0, self._shape[0], own):
            for left in range(0, self._shape[1], own):
                part = self._filtered(about[..., top : top + self._padded[0], left : left + self._padded[1]])
                into = filtered[..., top : top + own, left : left + own]
                into.copy_(part[..., self._reach :, self._reach :][..., : into.shape[-2], : into.shape[-1]])
        return filtered

    def _filtered(self, images: Tensor) -> Tensor:
        """Return images, 0 beyond their edges and up to the size of the transforms, filtered as if they went round."""
        return steady.irfft2(torch.fft.rfft2(images, s=self._padded).mul_(self._response), self._padded)

    def adjoint(self, images: Tensor) -> Tensor:
        """Return the filtered images."""
        return self(images)

    def transfer(self, along_y: Tensor, along_x: Tensor) -> Tensor:
        """Return the filter's response at frequencies (Fy,) by (Fx,), cycles per node: (Fy, Fx)."""
        reach = self._kernel.shape[0] // 2
        offsets = torch.arange(-reach, reach + 1).to(along_y)
        by_y, by_x = (torch.cos(2 * math.pi * along[:, None] * offsets) for along in (along_y, along_x))
        response: Tensor = by_y @ self._kernel.to(along_y) @ by_x.T
        return response


def disc(radius: float, edge: float) -> Tensor:
    """Return a disc with soft edges as an odd square kernel that sums to 1; radius and edge in nodes."""
    reach = max(1, math.ceil(radius + 3 * edge))
    fine = (torch.arange((2 * reach + 1) * _SUBSAMPLES) + 0.5) / _SUBSAMPLES - reach - 0.5
    distance = torch.hypot(fine[:, None], fine[None, :])
    inside = torch.special.erfc((distance - radius) / (math.sqrt(2) * edge)) / 2
    kernel = inside.reshape(2 * reach + 1, _SUBSAMPLES, 2 * reach + 1, _SUBSAMPLES).mean(dim=(1, 3))
    even: Tensor = kernel / kernel.sum()
    return even
