"""What every linear operator here has: itself, and its adjoint."""

from typing import Protocol, TypeVar

From = TypeVar("From")
To = TypeVar("To")


class LinearOperator(Protocol[From, To]):
    """A linear map A of pictures, samples or blocks of these.

    With the inner product over all elements, <A x, y> = <x, A' y>. ``tests/operators/test_adjoint.py`` holds every
    operator to that. Faster kernels take the place of operators, never of the code that uses them.
    """

    def __call__(self, x: From, /) -> To:
        """Return A x."""

    def adjoint(self, y: To, /) -> From:
        """Return A' y."""
