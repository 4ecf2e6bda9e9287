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

    torch's optimisers import triton, which comes with torch from PyPI, for nothing that is used here. From 3.7 on it
    shows its own LLVM to the whole process; where there is another the import ends in a segmentation fault, and napari
    with it (https://github.com/tensorflow/tensorflow/issues/124205 is the same clash). torch goes on as where triton
    is not installed.

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
