"""Loops compiled by numba, where array operations would pass over the same numbers again and again.

They are compiled for the types that are named, when the module that has them is imported, and kept on disk: that takes
some seconds once for each installation, and nothing while frames come in. `LiveEngine` imports them, when it is made.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])
# Sums may be taken in any order, for the same bits each time; NaN and infinity keep their meaning.
_FREEDOMS = {"reassoc", "contract", "nsz", "arcp"}


def compiled(*signatures: str) -> Callable[[_Function], _Function]:
    """Compile a function for numba's signatures, such as "void(f4[:,::1], i8)"."""
    decorate = numba.njit(list(signatures), cache=True, nogil=True, fastmath=_FREEDOMS, error_model="numpy")
    return cast(Callable[[_Function], _Function], decorate)
