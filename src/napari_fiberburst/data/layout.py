"""Layout: where the frames of an array lie, by the letters of its axes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.errors import BurstError


@dataclass(frozen=True, slots=True)
class Layout:
    """How to take frames from an array whose axes stand in any order, one slice at a time.

    Attributes
    ----------
    order : str
        A letter for each axis of the array.
    shape : tuple of int
        Frames, height, width and channels.
    """

    order: str
    shape: tuple[int, int, int, int]

    @classmethod
    def of(cls, shape: tuple[int, ...], axes: str | None) -> "Layout":
        """Return the layout of an array of this shape.

        Parameters
        ----------
        shape : tuple of int
            Of the array.
        axes : str, optional
            Its axes, such as "CTYX"; S and C are the same. The default goes by the number of axes.

        Raises
        ------
        BurstError
            The axes are no stack of frames, or do not fit the shape.
        """
        order = {2: "YX", 3: "TYX", 4: "TYXC"}.get(len(shape), "") if axes is None else axes
        if not isinstance(order, str):
            raise BurstError(f'axes must be one letter per axis, such as "CTYX"; got {axes!r}')
        order = order.upper().replace("S", "C")
        is_one_frame = "T" not in order and len(order) == len(shape)  # a burst where its bundle is known
        if not set("YX" if is_one_frame else "TYX") <= set(order) or not len(set(order)) == len(order) == len(shape):
            raise BurstError(
                "a burst is one stack with axes (time, height, width) or (time, height, width, channel); got shape "
                f"{tuple(shape)} with axes {order or 'unknown'}; open the frames as one stack, or name its axes: "
                'Burst(stack, axes="CTYX"), read_burst(path, axes="CTYX")'
            )
        sizes = dict(zip(order, shape, strict=True))
        for axis in order:
            if axis not in "TYXC" and sizes[axis] != 1:
                raise BurstError(
                    f"axis {axis} of {order} must have length 1, got {sizes[axis]}; take one position of it, or name "
                    "it T or C"
                )
        return cls(order, (int(sizes.get("T", 1)), int(sizes["Y"]), int(sizes["X"]), int(sizes.get("C", 1))))

    @property
    def axes(self) -> str:
        """Return "TYX" for grey frames, "TYXC" for frames with a channel axis."""
        return "TYXC" if "C" in self.order else "TYX"

    def take(self, array: Any, start: int, stop: int) -> NDArray[Any]:
        """Return frames start to stop of the array, (n, H, W, C), in its own type; nothing else of it is read."""
        key = tuple(slice(start, stop) if axis == "T" else slice(None) if axis in "YXC" else 0 for axis in self.order)
        while len(key) > 1 and key[-1] == slice(None):  # some arrays take slices of their first axis alone
            key = key[:-1]
        frames = np.asarray(array[key if len(key) > 1 else key[0]])
        kept = [axis for axis in self.order if axis in "TYXC"]
        if "T" not in kept:
            frames, kept = frames[None], ["T", *kept]
        frames = frames.transpose([kept.index(axis) for axis in self.axes])
        return frames if "C" in kept else frames[..., None]
