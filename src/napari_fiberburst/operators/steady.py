"""Arithmetic whose bits do not depend on the number of threads.

Torch gives every thread a part of a large sum, so that how it rounds depends on how many there are. Here elements are
added in blocks of one size, each by one thread, and the blocks' sums likewise; a product of matrices with long rows is
a sum, too. Nor does torch round a complex product alike at the ends of a thread's part and within it, or a batch of
inverse transforms in one thread and in several.
"""

import torch
from torch import Tensor

# Elements to a block: torch adds fewer than 32,768 values in one thread.
_BLOCK = 4096


def total(values: Tensor) -> Tensor:
    """Return the sum of all elements, a scalar."""
    flat = values.reshape(-1)
    while len(flat) > _BLOCK:
        whole = len(flat) // _BLOCK * _BLOCK
        blocks, rest = flat[:whole].reshape(-1, _BLOCK).sum(dim=1), flat[whole:].sum()
        flat = torch.cat([blocks, rest[None]])
    return flat.sum()


def row_sums(values: Tensor) -> Tensor:
    """Return the sums (...) over the last axis of values (..., K)."""
    while values.shape[-1] > _BLOCK:
        padded = torch.nn.functional.pad(values, (0, -values.shape[-1] % _BLOCK))
        values = padded.reshape(*values.shape[:-1], -1, _BLOCK).sum(dim=-1)
    return values.sum(dim=-1)


def mean(values: Tensor) -> Tensor:
    """Return the mean of all elements, a scalar."""
    return total(values) / values.numel()


def weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    """Return the mean of values by weights of the same shape, a scalar; 0 where nothing has weight."""
    return total(values * weights) / total(weights).clamp_min(1e-12)


def complex_product(first: Tensor, second: Tensor) -> Tensor:
    """Return the product of two complex tensors, by products of real ones."""
    (a, b), (c, d) = ((part.real, part.imag) for part in (first, second))
    return torch.complex(a * c - b * d, a * d + b * c)


def irfft2(spectra: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return the images (..., H, W) of spectra, transformed back one by one."""
    images = [torch.fft.irfft2(spectrum, s=shape) for spectrum in spectra.reshape(-1, *spectra.shape[-2:])]
    together = images[0] if len(images) == 1 else torch.stack(images)
    return together.reshape(*spectra.shape[:-2], *shape)
