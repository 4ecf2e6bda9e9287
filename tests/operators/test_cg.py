"""Conjugate gradients come to what scipy's come to, and to the solution."""

import numpy as np
import pytest
import scipy.sparse.linalg
import torch

from napari_fiberburst.operators.cg import conjugate_gradients, inner_of_images
from napari_fiberburst.operators.priors import THIN_PLATE

SHAPE = (13, 17)


def system(seed=0):
    """Return a matrix, positive definite and badly scaled, and a right-hand side."""
    rng = np.random.default_rng(seed)
    half = rng.standard_normal((23, 23))
    scale = np.diag(10 ** rng.uniform(-2, 2, 23))
    return scale @ (half @ half.T + np.eye(23)) @ scale, rng.standard_normal(23)


@pytest.mark.parametrize("steps", [1, 2, 3, 7])
def test_every_step_is_scipys(steps):
    matrix, rhs = system()
    inverse = 1 / np.diag(matrix)
    expected, _ = scipy.sparse.linalg.cg(matrix, rhs, rtol=0, maxiter=steps, M=np.diag(inverse))
    a, b, m = (torch.from_numpy(part) for part in (matrix, rhs, inverse))
    (found,) = conjugate_gradients(lambda x: (a @ x[0],), (b,), lambda r: (m * r[0],), iterations=steps, tolerance=0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_blocks_are_one_system_in_parts():
    matrix, rhs = system(1)
    a, b = torch.from_numpy(matrix), torch.from_numpy(rhs)
    inverse = 1 / a.diagonal()

    def multiply(blocks):
        return (a @ torch.cat([part.ravel() for part in blocks])).split([15, 8])

    def precondition(blocks):
        return (inverse * torch.cat([part.ravel() for part in blocks])).split([15, 8])

    found = conjugate_gradients(multiply, b.split([15, 8]), precondition, iterations=200, tolerance=1e-12)
    np.testing.assert_allclose(torch.cat(found), np.linalg.solve(matrix, rhs), rtol=1e-6)


def test_images_that_share_a_matrix_are_solved_as_if_alone():
    rhs = torch.randn(3, *SHAPE, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    rhs[1] *= 1e3

    def solved(images):
        (found,) = conjugate_gradients(
            lambda x: (THIN_PLATE(x[0]) + 0.1 * x[0],),
            (images,),
            lambda r: r,
            start=(torch.ones_like(images),),
            iterations=60,
            tolerance=0.0,
            inner=inner_of_images,
        )
        return found

    for number in range(3):
        torch.testing.assert_close(solved(rhs)[number], solved(rhs[number : number + 1])[0])


def test_it_ends_once_the_error_is_small_and_goes_on_from_a_start():
    matrix, rhs = system(2)
    a, b = torch.from_numpy(matrix), torch.from_numpy(rhs)
    inverse = 1 / a.diagonal()
    products = []

    def multiply(blocks):
        products.append(1)
        return (a @ blocks[0],)

    def solved(start, tolerance):
        products.clear()
        (found,) = conjugate_gradients(
            multiply, (b,), lambda r: (inverse * r[0],), start=start, iterations=400, tolerance=tolerance
        )
        return found, len(products)

    rough, few = solved(None, 1e-1)
    exact, many = solved(None, 1e-10)
    assert few < many < 400
    np.testing.assert_allclose(exact, np.linalg.solve(matrix, rhs), rtol=1e-5)
    left = b - a @ rough
    assert (left * inverse * left).sum() <= 1e-2 * (b * inverse * b).sum()
    again, nearly_none = solved((exact,), 1e-1)
    assert nearly_none <= 5
    np.testing.assert_allclose(again, exact, rtol=1e-5)


def test_nothing_to_solve_gives_nothing():
    (found,) = conjugate_gradients(lambda x: x, (torch.zeros(5),), lambda r: r, iterations=10, tolerance=1e-3)
    assert torch.equal(found, torch.zeros(5))
