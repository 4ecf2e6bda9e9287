"""Priors on how smooth an image is, as the matrices of their energies."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class SmoothnessPrior:
    """The matrix P of an energy x' P x / 2 of images, which is its own adjoint.

    Attributes
    ----------
    order : int
        1 for the membrane, sum of squared slopes: P = D'D with D the differences between neighbours. 2 for the thin
        plate, of curvature: P = (D'D)^2.
    """

    order: Literal[1, 2]

    def __call__(self, images: Tensor) -> Tensor:
        """Return P x for images (..., H, W)."""
        for _ in range(self.order):
            images = _slopes_squared(images)
        return images

    def adjoint(self, images: Tensor) -> Tensor:
        """Return P x."""
        return self(images)

    @property
    def diagonal(self) -> float:
        """The elements on the diagonal of P, away from the edges."""
        return {1: 4.0, 2: 20.0}[self.order]

    def response(self, along_y: Tensor, along_x: Tensor) -> Tensor:
        """Return P of waves of frequencies (Fy,) by (Fx,), cycles per node: (Fy, Fx)."""
        slope_y, slope_x = (4 * torch.sin(math.pi * along) ** 2 for along in (along_y, along_x))
        response: Tensor = (slope_y[:, None] + slope_x) ** self.order
        return response


MEMBRANE, THIN_PLATE = SmoothnessPrior(1), SmoothnessPrior(2)


def _slopes_squared(x: Tensor) -> Tensor:
    """Return D'D x."""
    y = torch.zeros_like(x)
    step = x[..., :, 1:] - x[..., :, :-1]
    y[..., :, 1:] += step
    y[..., :, :-1] -= step
    step = x[..., 1:, :] - x[..., :-1, :]
    y[..., 1:, :] += step
    y[..., :-1, :] -= step
    return y
