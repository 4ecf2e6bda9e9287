"""A smooth scene, and what scattered samples of moving frames see of it."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

SHAPE = (120, 140)


def scene(points: Tensor) -> Tensor:
    """Return the light at points (..., 2)."""
    x, y = points[..., 0], points[..., 1]
    return 1 + 0.3 * torch.sin(x / 7 + 0.3 * y / 5) + 0.3 * torch.cos(y / 8 - x / 23) + 0.2 * torch.sin((x + y) / 17)


@pytest.fixture
def positions() -> Tensor:
    """Return 900 places in frames of 120 x 140 pixels."""
    generator = torch.Generator().manual_seed(1)
    return torch.rand(900, 2, generator=generator) * torch.tensor([139.0, 119.0])


@pytest.fixture(scope="session")
def matrices() -> Callable[..., NDArray[np.float64]]:
    """Return a function that gives five rigid motions about the frame's middle; the first is the identity."""

    def make(angle: float = 0.02, shift: float = 9.0) -> NDArray[np.float64]:
        found = []
        for number in range(5):
            cosine, sine = np.cos(angle * number), np.sin(angle * number)
            centre = np.array([69.5, 59.5])
            linear = np.array([[cosine, -sine], [sine, cosine]])
            offset = centre - linear @ centre + shift * np.array([np.sin(number), 1 - np.cos(number)])
            found.append(np.vstack([np.column_stack([linear, offset]), [0, 0, 1]]))
        return np.array(found)

    return make


@pytest.fixture(scope="session")
def look() -> Callable[[Tensor, NDArray[np.float64]], Tensor]:
    """Return a function that gives what frames see at places (N, 2), (T, N)."""

    def seen(positions: Tensor, homographies: NDArray[np.float64]) -> Tensor:
        placed = (
            torch.cat([positions, torch.ones(len(positions), 1)], dim=1) @ torch.from_numpy(homographies).float().mT
        )
        return scene(placed[..., :2] / placed[..., 2:])

    return seen
