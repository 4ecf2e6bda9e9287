"""Which frames of a recording are meant."""

import re

from napari_fiberburst.errors import BurstError

_SLICE = re.compile(r"\s*(-?\d+)?\s*:\s*(-?\d+)?\s*(?::\s*(-?\d+)?\s*)?")


def chosen_frames(frames: str | slice | None, count: int, name: str) -> range:
    """Return the numbers of the frames that are asked for; all of them where nothing is.

    Parameters
    ----------
    frames : str or slice, optional
        As Python slices: "100:120" are the frames 100 to 119, "100:200:5" every fifth of 100 to 199, "-20:" the last
        twenty.
    count : int
        Frames of the recording.
    name : str
        How it is called.

    Raises
    ------
    BurstError
        It is no slice, or leaves no frame.
    """
    part = frames
    if part is None:
        return range(count)
    if isinstance(part, str):
        found = _SLICE.fullmatch(part)
        part = None if found is None else slice(*(None if edge is None else int(edge) for edge in found.groups()))
    try:
        numbers = range(count)[part] if isinstance(part, slice) else None
    except (TypeError, ValueError):  # a step of 0, or edges that are no integers
        numbers = None
    if numbers is None:
        raise BurstError(f'frames must be a slice such as "100:120" or "100:200:5"; got {frames!r}')
    if not numbers:
        raise BurstError(f"{name} has {count} frames, 0 to {count - 1}, and none of them is in {frames}; choose others")
    return numbers
