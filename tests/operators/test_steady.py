"""What adds up to the same bits whatever the number of threads."""

import math

import pytest
import torch

from napari_fiberburst.operators import steady


@pytest.fixture(autouse=True)
def threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def by_threads(function):
    """Return what a function returns with one thread, two, three and seven."""
    found = []
    for count in (1, 2, 3, 7):
        torch.set_num_threads(count)
        found.append(function())
    return found


@pytest.mark.parametrize("shape", [(), (1,), (4096,), (4097,), (20, 8447), (3, 211, 307)])
def test_a_total_does_not_depend_on_threads(shape):
    values = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    first, *others = by_threads(lambda: steady.total(values))
    assert all(torch.equal(first, other) for other in others)
    assert float(first) == pytest.approx(math.fsum(values.flatten().tolist()), rel=1e-6)


@pytest.mark.parametrize("shape", [(5, 1), (3, 4096), (2, 3, 9001), (211, 4099)])
def test_sums_of_rows_do_not_depend_on_threads(shape):
    values = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    first, *others = by_threads(lambda: steady.row_sums(values))
    assert all(torch.equal(first, other) for other in others)
    torch.testing.assert_close(first, values.double().sum(dim=-1).float())


def test_means_are_means():
    values, weights = torch.rand(2, 91, 503, generator=torch.Generator().manual_seed(2))
    assert float(steady.mean(values)) == pytest.approx(float(values.double().mean()), rel=1e-6)
    expected = (values.double() * weights.double()).sum() / weights.double().sum()
    assert float(steady.weighted_mean(values, weights)) == pytest.approx(float(expected), rel=1e-6)
    assert float(steady.weighted_mean(values, torch.zeros_like(weights))) == 0


def test_complex_products_do_not_depend_on_threads():
    first, second = torch.randn(2, 20, 4123, dtype=torch.complex64, generator=torch.Generator().manual_seed(3))
    one, *others = by_threads(lambda: steady.complex_product(first, second))
    assert all(torch.equal(one, other) for other in others)
    torch.testing.assert_close(one, first * second)


@pytest.mark.parametrize("shape", [(72, 64), (59, 45)])
def test_transforming_back_does_not_depend_on_threads(shape):
    images = torch.rand(2, 3, *shape, generator=torch.Generator().manual_seed(4))
    spectra = torch.fft.rfft2(images)
    one, *others = by_threads(lambda: steady.irfft2(spectra, shape))
    assert all(torch.equal(one, other) for other in others)
    torch.testing.assert_close(one, images)
