"""Loops compiled by numba, where array operations would pass over the same numbers again and again.

They are compiled for the types that are named, when the module that has them is imported, and kept on disk: that takes
some seconds once for each installation, and nothing while frames come in. `LiveEngine` imports them, when it is made.
Where nothing can be kept, because neither the package's folder nor the user's cache can be written, they are compiled
at every start.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])
# Sums may be taken in any order, for the same bits each time; NaN and infinity keep their meaning.
_FREEDOMS = {"reassoc", "contract", "nsz", "arcp"}


def compiled(*signatures: str) -> Callable[[_Function], _Function]:
    """Compile a function for numba's signatures, such as "void(f4[:,::1], i8)"."""

    def decorate(function: _Function) -> _Function:
        try:
            made = _compile(function, signatures, is_kept=True)
        except RuntimeError as error:
            if "no locator" not in str(error):
                raise
            made = _compile(function, signatures, is_kept=False)
        return cast(_Function, made)

    return decorate


def _compile(function: _Function, signatures: tuple[str, ...], *, is_kept: bool) -> Any:
    return numba.njit(list(signatures), cache=is_kept, nogil=True, fastmath=_FREEDOMS, error_model="numpy")(function)
