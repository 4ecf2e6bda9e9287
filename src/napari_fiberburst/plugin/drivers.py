"""Keeps two copies of LLVM out of one process: the graphics driver's, and that of triton."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# What this process has mapped into memory; there on Linux alone, as triton is.
_MAPS = Path("/proc/self/maps")


@contextmanager
def without_clash(maps: Path = _MAPS) -> Iterator[None]:
    """Let no import of triton succeed where a driver has loaded LLVM, as Mesa's have once a canvas is drawn.

    torch's optimisers import triton, which is installed with torch from PyPI, although nothing here uses it. From 3.7
    on, triton exposes its own LLVM to the whole process; where another one is loaded, the import ends in a
    segmentation fault, which ends napari (https://github.com/tensorflow/tensorflow/issues/124205 is the same clash).
    torch then works as if triton were not installed.

    Parameters
    ----------
    maps : Path
        Lists the libraries of the process.
    """
    is_needed = "triton" not in sys.modules and maps.exists() and "libLLVM" in maps.read_text()
    if is_needed:
        sys.modules["triton"] = None  # type: ignore[assignment]  # how Python marks what must not be imported
    try:
        yield
    finally:
        if is_needed:
            sys.modules.pop("triton", None)
