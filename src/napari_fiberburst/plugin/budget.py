"""Whether a run fits into memory, asked before it starts."""

from collections.abc import Mapping
from typing import Any

import psutil

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.memory import estimate_memory
from napari_fiberburst.plugin.bursts import BurstSource
from napari_fiberburst.settings import choose

_GIGABYTE = 2**30
# The rest of the machine needs some memory too.
_MOST_OF_MEMORY = 0.9


def in_words(source: BurstSource, choices: Mapping[str, Any], missing: Mapping[str, str] | None) -> str:
    """Return what a run will take and what there is; `missing` as in `memory_of`."""
    needed, free = memory_of(source, choices, missing)
    return f"about {needed / _GIGABYTE:.1f} GB of memory, {free / _GIGABYTE:.0f} GB are free"


def refuse_what_cannot_fit(source: BurstSource, choices: Mapping[str, Any], missing: Mapping[str, str] | None) -> None:
    """Refuse a run that would take more memory than there is.

    Raises
    ------
    FiberBurstError
        Says how much, and what would help.
    """
    needed, free = memory_of(source, choices, missing)
    if needed > _MOST_OF_MEMORY * free:
        raise FiberBurstError(
            f"this run would take about {needed / _GIGABYTE:.1f} GB of memory, and {free / _GIGABYTE:.1f} GB are "
            "free; draw a region, use fewer frames, lower the upsampling, or choose another device"
        )


def memory_of(source: BurstSource, choices: Mapping[str, Any], missing: Mapping[str, str] | None) -> tuple[int, int]:
    """Return the bytes that a run will take, about, and those that are free where it runs.

    `missing` has the devices that are not here; None while PyTorch has not been loaded to tell.
    """
    settings = choose(**choices)
    free = psutil.virtual_memory().available
    if missing is not None and "cuda" not in missing:
        from napari_fiberburst.device import free_memory

        free = free_memory(settings.device) or free
    return estimate_memory(source.shape, settings), free
