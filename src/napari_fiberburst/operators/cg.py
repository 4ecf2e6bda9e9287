"""Conjugate gradients, over one block of unknowns or several."""

from collections.abc import Callable

import torch
from torch import Tensor

from napari_fiberburst.operators import steady

# Unknowns in blocks of any shapes, such as a scene, the motion of its frames, and gains.
Blocks = tuple[Tensor, ...]
# Looking at the error makes the host wait for the device.
_ITERATIONS_BETWEEN_LOOKS = 4
_LEAST_POWER = 1e-30


def conjugate_gradients(
    multiply: Callable[[Blocks], Blocks],
    rhs: Blocks,
    precondition: Callable[[Blocks], Blocks],
    *,
    start: Blocks | None = None,
    iterations: int,
    tolerance: float,
    inner: Callable[[Blocks, Blocks], Tensor] | None = None,
) -> Blocks:
    """Solve A x = b for a symmetric positive definite A (Hestenes and Stiefel, 1952), preconditioned.

    Parameters
    ----------
    multiply : callable
        Blocks x to A x.
    rhs : tuple of Tensor
        b.
    precondition : callable
        Blocks r to M r, with M symmetric, positive definite and close to the inverse of A.
    start : tuple of Tensor, optional
        Where to start; zero by default.
    iterations : int
        At most.
    tolerance : float
        Ends once the residual r has r' M r <= tolerance^2 b' M b.
    inner : callable, optional
        Inner product. By default over all blocks, which gives a scalar; `inner_of_images` solves for several
        images that share one A at once.

    Returns
    -------
    tuple of Tensor
        x.
    """
    inner = inner_of_blocks if inner is None else inner
    if start is None:
        solution, residual = tuple(part * 0 for part in rhs), rhs
    else:
        product = multiply(start)
        solution, residual = start, tuple(part - other for part, other in zip(rhs, product, strict=True))
    search = ready = precondition(residual)
    power = inner(residual, ready)
    enough = tolerance**2 * (power if start is None else inner(rhs, precondition(rhs)))
    for number in range(1, iterations + 1):
        product = multiply(search)
        step = power / inner(search, product).clamp_min(_LEAST_POWER)
        solution = _add(solution, step, search)
        residual = _add(residual, -step, product)
        ready = precondition(residual)
        before, power = power, inner(residual, ready)
        if number % _ITERATIONS_BETWEEN_LOOKS == 0 and bool((power <= enough).all()):
            break
        search = _add(ready, power / before.clamp_min(_LEAST_POWER), search)
    return solution


def inner_of_blocks(first: Blocks, second: Blocks) -> Tensor:
    """Return the inner product over all blocks, a scalar."""
    total: Tensor = sum(steady.total(a * b) for a, b in zip(first, second, strict=True))  # type: ignore[assignment]
    return total


def inner_of_images(first: Blocks, second: Blocks) -> Tensor:
    """Return the inner product of each of C images (C, H, W) with its counterpart, (C, 1, 1)."""
    (a,), (b,) = first, second
    return torch.stack([steady.total(product) for product in a * b])[:, None, None]


def _add(blocks: Blocks, factor: Tensor, others: Blocks) -> Blocks:
    return tuple(torch.addcmul(part, factor, other) for part, other in zip(blocks, others, strict=True))
