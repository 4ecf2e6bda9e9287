"""What a reader hands over: pixels as they came, and what their file says of them."""

import logging
import math
from dataclasses import dataclass
from typing import Any

logger = logging.getLogger(__name__)

# What files call the axis of frames where they do not call it time; a burst has no depth.
_FRAME_AXES = "QIZ"
_UNITS = {"micrometer": "µm", "micron": "µm", "um": "µm", "μm": "µm", "nanometer": "nm", "millimeter": "mm"}


def with_time(axes: str) -> str:
    """Return axes with the one that frames lie along called T."""
    for axis in _FRAME_AXES:
        if "T" not in axes and axis in axes:
            axes = axes.replace(axis, "T")
    return axes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """The pixels of a file and what it says of them; None or empty where it says nothing.

    Attributes
    ----------
    pixels : array
        Anything with `shape`, `dtype` and slices that numpy takes; of a file, what reads a slice when it is asked for.
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
    black_level, white_level : float or None
        Intensities of no light and of full scale.
    """

    pixels: Any
    axes: str | None = None
    channel_names: tuple[str, ...] = ()
    pixel_size: tuple[float, float] | None = None
    unit: str | None = None
    times: list[float] | None = None
    black_level: float | None = None
    white_level: float | None = None

    def usable_metadata(self, axes: str | None) -> dict[str, Any]:
        """Return what the file says beside its pixels, less what cannot be true of them.

        Wrong metadata is no reason to refuse good pixels: it is left out, and a warning is logged.
        """
        lengths = dict(zip(axes or self.axes or "TYXC", self.pixels.shape, strict=False))
        channels, frames = lengths.get("C", lengths.get("S", 1)), lengths.get("T")
        found: dict[str, Any] = {}
        for name, value, is_possible in (
            ("channel_names", self.channel_names, len(self.channel_names) == channels),
            ("pixel_size", self.pixel_size, all(0 < side < math.inf for side in self.pixel_size or ())),
            ("times", self.times, len(self.times or ()) == frames and all(map(math.isfinite, self.times or ()))),
        ):
            if value and is_possible:
                found[name] = value
            elif value:
                logger.warning("ignoring the file's %s, which cannot be: %s", name, value)
        if self.unit is not None:
            found["unit"] = _UNITS.get(self.unit.lower(), self.unit)
        return found
