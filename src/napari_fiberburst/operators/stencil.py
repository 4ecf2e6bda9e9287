"""A sparse matrix over the nodes of a grid."""

import torch
from torch import Tensor


class Stencil:
    """A symmetric matrix over nodes that couples each to its eight neighbours; it is its own adjoint.

    Parameters
    ----------
    bands : Tensor
        (5, H, W): the diagonal, and the couplings to the right, below, below right and below left.
    """

    def __init__(self, bands: Tensor) -> None:
        self.bands = bands

    @property
    def diagonal(self) -> Tensor:
        """The diagonal, (H, W)."""
        return self.bands[0]

    @property
    def row_sums(self) -> Tensor:
        """The sum of each row, (H, W): what the matrix does to an even image of ones."""
        return self(torch.ones_like(self.diagonal))

    def __call__(self, x: Tensor) -> Tensor:
        """Return the product with images (..., H, W)."""
        diagonal, right, below, below_right, below_left = self.bands
        y: Tensor = diagonal * x
        coupling = right[:, :-1]
        y[..., :, :-1].addcmul_(coupling, x[..., :, 1:])
        y[..., :, 1:].addcmul_(coupling, x[..., :, :-1])
        coupling = below[:-1]
        y[..., :-1, :].addcmul_(coupling, x[..., 1:, :])
        y[..., 1:, :].addcmul_(coupling, x[..., :-1, :])
        coupling = below_right[:-1, :-1]
        y[..., :-1, :-1].addcmul_(coupling, x[..., 1:, 1:])
        y[..., 1:, 1:].addcmul_(coupling, x[..., :-1, :-1])
        coupling = below_left[:-1, 1:]
        y[..., :-1, 1:].addcmul_(coupling, x[..., 1:, :-1])
        y[..., 1:, :-1].addcmul_(coupling, x[..., :-1, 1:])
        return y

    def adjoint(self, x: Tensor) -> Tensor:
        """Return the product with images (..., H, W)."""
        return self(x)
