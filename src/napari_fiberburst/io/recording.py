"""What a reader hands over: pixels as they came, and what their file says of them."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """The pixels of a file and what it says of them; None or empty where it says nothing.

    Attributes
    ----------
    pixels : array
        numpy, or another array that numpy can take slices of.
    axes : str or None
        A letter per axis.
    channel_names : tuple of str
        One per channel.
    pixel_size : (float, float) or None
        Height and width of a pixel, in `unit`.
    unit : str or None
        Unit of length.
    times : list of float or None
        Seconds, one per frame.
    """

    pixels: Any
    axes: str | None = None
    channel_names: tuple[str, ...] = ()
    pixel_size: tuple[float, float] | None = None
    unit: str | None = None
    times: list[float] | None = None
