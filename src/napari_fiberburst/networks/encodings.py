"""Positional encodings gamma: coordinates (N, D) to features (N, width). Each module knows its own width."""

import math

import torch
from torch import Generator, Tensor, nn

from napari_fiberburst import settings

# The primes of Teschner et al. (2003) by which Müller et al. (2022), equation 4, hash grid points.
_HASH_PRIMES = (1, 2_654_435_761, 805_459_861)
# Motion takes points out of frame 0's field; coarse levels store a margin of half a frame on every side.
_HASH_REACH = 2.0


class Coordinates(nn.Module):
    """gamma(p) = p."""

    def __init__(self, dimensions: int) -> None:
        super().__init__()
        self.width = dimensions

    def forward(self, points: Tensor) -> Tensor:
        """Return the points themselves."""
        return points


class Octaves(nn.Module):
    """gamma(p) = (p, sin(2^k pi p), cos(2^k pi p)), k = 0 .. L (Mildenhall et al., 2020, equation 4)."""

    frequencies: Tensor

    def __init__(self, dimensions: int, highest_octave: int) -> None:
        super().__init__()
        self.width = dimensions * (1 + 2 * (highest_octave + 1))
        self.register_buffer("frequencies", math.pi * 2.0 ** torch.arange(highest_octave + 1))

    def forward(self, points: Tensor) -> Tensor:
        """Return (N, width): the points, all sines, all cosines."""
        angles = (points[:, :, None] * self.frequencies).flatten(1)
        return torch.cat([points, torch.sin(angles), torch.cos(angles)], dim=1)


class RandomFourier(nn.Module):
    """gamma(p) = (p, sin(2 pi b_i . p), cos(2 pi b_i . p)), b_i ~ N(0, sigma^2) (Tancik et al., 2020).

    The directions are drawn once, at sigma 1, and scaled: sigma can change while a fit runs.
    """

    directions: Tensor
    sigma: Tensor

    def __init__(self, dimensions: int, features: int, sigma: float, generator: Generator) -> None:
        super().__init__()
        self.width = dimensions + 2 * features
        self.register_buffer("directions", torch.randn(features, dimensions, generator=generator))
        self.register_buffer("sigma", torch.tensor(float(sigma)))

    def forward(self, points: Tensor) -> Tensor:
        """Return (N, width): the points, all sines, all cosines."""
        angles = points @ (2 * math.pi * self.sigma * self.directions).T
        return torch.cat([points, torch.sin(angles), torch.cos(angles)], dim=1)


class HashGrid(nn.Module):
    """Multi-resolution hash grid (Müller et al., 2022), in plain torch.

    Level l lays ``floor(base_resolution * growth**l)`` cells across the frame. Its grid points have a place each
    in the level's table where they fit, and share places by a hash where they do not. The features at the corners
    around a point are blended linearly.
    """

    corners: Tensor
    primes: Tensor

    def __init__(self, dimensions: int, choice: settings.Hash, generator: Generator) -> None:
        super().__init__()
        self.width = choice.levels * choice.level_features
        self.resolutions = [math.floor(choice.base_resolution * choice.growth**level) for level in range(choice.levels)]
        limit = 2**choice.table_bits
        tables = []
        for resolution in self.resolutions:
            points = (math.ceil(_HASH_REACH * resolution) + 1) ** dimensions
            table = torch.empty(min(points, limit), choice.level_features)
            tables.append(nn.Parameter(table.uniform_(-1e-4, 1e-4, generator=generator)))
        self.tables = nn.ParameterList(tables)
        self.limit = limit
        sides = torch.tensor([0, 1])
        self.register_buffer("corners", torch.cartesian_prod(*[sides] * dimensions))
        self.register_buffer("primes", torch.tensor(_HASH_PRIMES[:dimensions]))

    def forward(self, points: Tensor) -> Tensor:
        """Return (N, width): each level's blended features, coarse to fine."""
        levels = zip(self.resolutions, self.tables, strict=True)
        return torch.cat([self._level(points, resolution, table) for resolution, table in levels], dim=1)

    def _level(self, points: Tensor, resolution: int, table: Tensor) -> Tensor:
        side = math.ceil(_HASH_REACH * resolution) + 1
        # Beyond the margin the nearest stored value holds on: there is nothing to learn there.
        cells = ((points / _HASH_REACH + 1) / 2 * (side - 1)).clamp(0, side - 1)
        lower = cells.detach().floor().clamp(max=side - 2)
        fraction = (cells - lower)[:, None, :]
        # Once a fit has diverged, points are no numbers; their cells must still be some.
        corners = lower.nan_to_num().long()[:, None, :] + self.corners
        weights = torch.where(self.corners.bool(), fraction, 1 - fraction).prod(dim=2)
        features = nn.functional.embedding(self._places(corners, side, len(table)), table)
        return (features * weights[:, :, None]).sum(dim=1)

    def _places(self, corners: Tensor, side: int, length: int) -> Tensor:
        """Return where in its table each corner (N, 2^D, D) stands."""
        if length == side ** corners.shape[2]:
            strides = side ** torch.arange(corners.shape[2], device=corners.device)
            return (corners * strides).sum(dim=2)
        terms = corners * self.primes
        mixed = terms[..., 0]
        for dimension in range(1, corners.shape[2]):
            mixed = mixed ^ terms[..., dimension]
        return mixed % length
