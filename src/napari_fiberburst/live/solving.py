"""Conjugate gradients for the normal equations of a live scene, in two passes over the nodes for each step.

The matrix couples each node to its eight neighbours: by what samples have added, five bands (the diagonal, and the
couplings to the right, below, below right and below left), and by the membrane, which ties each node to the four next
to it. Images and bands are (rows, columns) float32; their outermost ring mirrors what is inside, where bands have 0.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.live.compiled import compiled

Floats = NDArray[np.float32]
# Planes of bands, before the right-hand sides.
BANDS = 5
_LEAST_POWER = 1e-30


@compiled("void(f4[:,::1])")
def mirror(image: Floats) -> None:
    """Let the outermost ring be what is next to it."""
    rows, columns = image.shape
    image[0], image[rows - 1] = image[1], image[rows - 2]
    for row in range(rows):
        image[row, 0], image[row, columns - 1] = image[row, 1], image[row, columns - 2]


@compiled("f4(f4[:,:,::1], f4, f4[:,::1], f4[::1], i8)")
def multiply_row(planes: Floats, tie: Any, x: Floats, product: Floats, row: int) -> Any:
    """Put one row of A x into `product`, and return its inner product with x."""
    count = x.shape[1] - 2
    above_left, above, above_right = x[row - 1, :count], x[row - 1, 1 : count + 1], x[row - 1, 2:]
    left, here, right = x[row, :count], x[row, 1 : count + 1], x[row, 2:]
    below_left, below, below_right = x[row + 1, :count], x[row + 1, 1 : count + 1], x[row + 1, 2:]
    diagonal, to_right, to_left = planes[0, row, 1 : count + 1], planes[1, row, 1 : count + 1], planes[1, row, :count]
    to_below, to_above = planes[2, row, 1 : count + 1], planes[2, row - 1, 1 : count + 1]
    to_below_right, to_above_left = planes[3, row, 1 : count + 1], planes[3, row - 1, :count]
    to_below_left, to_above_right = planes[4, row, 1 : count + 1], planes[4, row - 1, 2:]
    four_ties, inner = np.float32(4) * tie, np.float32(0)
    for j in range(count):
        along = (diagonal[j] + four_ties) * here[j] + (to_right[j] - tie) * right[j] + (to_left[j] - tie) * left[j]
        across = (to_below[j] - tie) * below[j] + (to_above[j] - tie) * above[j]
        falling = to_below_right[j] * below_right[j] + to_above_left[j] * above_left[j]
        rising = to_below_left[j] * below_left[j] + to_above_right[j] * above_right[j]
        there = (along + across) + (falling + rising)
        product[j + 1] = there
        inner += there * here[j]
    return inner


@compiled("void(f4[:,:,::1], f4, f4[:,::1], f4[:,::1])")
def multiply(planes: Floats, tie: Any, x: Floats, product: Floats) -> None:
    """Put A x into `product`, but for its ring."""
    mirror(x)
    for row in range(1, x.shape[0] - 1):
        multiply_row(planes, tie, x, product[row], row)


@compiled("f8(f4[:,:,::1], f4, f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1])")
def _begin(planes: Floats, tie: Any, x: Floats, right_hand: Floats, product: Floats, residual: Floats) -> Any:
    """Make the residual at x; return its power, which is its inner product with itself over the diagonal."""
    rows, columns = x.shape
    four_ties = np.float32(4) * tie
    total: Any = 0.0
    mirror(x)
    for row in range(1, rows - 1):
        multiply_row(planes, tie, x, product[row], row)
        wanted, there, left, diagonal = right_hand[row], product[row], residual[row], planes[0, row]
        power = np.float32(0)
        for j in range(1, columns - 1):
            left[j] = wanted[j] - there[j]
            power += left[j] * left[j] / (diagonal[j] + four_ties)
        total += power
    return total


@compiled("f8(f4[:,:,::1], f4, f4, f4[:,::1], f4[:,::1], f4[:,::1])")
def _search(planes: Floats, tie: Any, kept: Any, residual: Floats, search: Floats, product: Floats) -> Any:
    """Turn the search to the residual over the diagonal, multiply it, and return their inner product."""
    rows, columns = search.shape
    four_ties, total = np.float32(4) * tie, 0.0
    for row in range(1, rows):
        if row < rows - 1:
            left, going, diagonal = residual[row], search[row], planes[0, row]
            for j in range(1, columns - 1):
                going[j] = left[j] / (diagonal[j] + four_ties) + kept * going[j]
            going[0], going[columns - 1] = going[1], going[columns - 2]
            if row == 1:
                search[0] = going
        else:
            search[row] = search[row - 1]
        if row > 1:
            total += multiply_row(planes, tie, search, product[row - 1], row - 1)
    return total


@compiled("f8(f4[:,:,::1], f4, f4, f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1])")
def _step(planes: Floats, tie: Any, by: Any, search: Floats, product: Floats, x: Floats, residual: Floats) -> Any:
    """Go along the search, and return the power of what is left."""
    rows, columns = x.shape
    four_ties = np.float32(4) * tie
    total: Any = 0.0
    for row in range(1, rows - 1):
        at, left, going, there, diagonal = x[row], residual[row], search[row], product[row], planes[0, row]
        power = np.float32(0)
        for j in range(1, columns - 1):
            at[j] += by * going[j]
            left[j] -= by * there[j]
            power += left[j] * left[j] / (diagonal[j] + four_ties)
        total += power
    return total


@compiled("void(f4[:,:,::1], f4, f4[:,:,::1], f4[:,:,::1], i8)")
def solve(planes: Floats, tie: Any, images: Floats, spare: Floats, iterations: int) -> None:
    """Take steps of conjugate gradients, preconditioned by the diagonal, from images as they stand.

    Parameters
    ----------
    planes : numpy.ndarray
        (5 + C, rows, columns) float32, the bands and the right-hand sides.
    tie : numpy.float32
        Weight of the membrane.
    images : numpy.ndarray
        (C, rows, columns) float32, from where to start, and what is found.
    spare : numpy.ndarray
        (3, rows, columns) float32, to work in.
    iterations : int
        How many steps.
    """
    residual, search, product = spare[0], spare[1], spare[2]
    for channel in range(len(images)):
        x = images[channel]
        power = _begin(planes, tie, x, planes[BANDS + channel], product, residual)
        search[:], kept = 0, np.float32(0)
        for _ in range(iterations):
            across = _search(planes, tie, kept, residual, search, product)
            by = np.float32(power / max(across, _LEAST_POWER))
            before = power
            power = _step(planes, tie, by, search, product, x, residual)
            kept = np.float32(power / max(before, _LEAST_POWER))
        mirror(x)
