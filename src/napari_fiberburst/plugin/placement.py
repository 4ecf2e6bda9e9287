"""Where the arrays of a result lie beside the burst they came from: axes, scale, units, and what colours they have."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from napari.layers import Image
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.canvas import Canvas

# Of what `as_colour` returns.
COLOUR_LIMITS = (0.0, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Placement:
    """Where a burst lay in the viewer when its run began, because its layers may be gone when the run ends.

    Attributes
    ----------
    axes : str
        Order of the layer's own axes, such as "TYX" or "CTYX"; an rgb layer's colours are none of them.
    sizes : dict
        Length of each axis.
    rgb : bool
        Whether its last data axis is shown as colour.
    scale, translate : tuple of float
        One per axis.
    units, axis_labels : tuple
        One per axis.
    world_from_data : numpy.ndarray or None
        3x3, data (y, x) to world, where the layer is rotated, sheared or has an affine transform.
    origin : (int, int)
        Row and column of the burst's first pixel in the layer.
    colormaps : tuple
        One for each of its layers; None for rgb.
    limits : tuple of (float, float)
        Contrast of each of its layers.
    channels : tuple of str
        The layers' names where each is a channel; empty for a burst in one layer.
    """

    axes: str
    sizes: dict[str, int]
    rgb: bool
    scale: tuple[float, ...]
    translate: tuple[float, ...]
    units: tuple[Any, ...]
    axis_labels: tuple[str, ...]
    world_from_data: NDArray[np.float64] | None
    origin: tuple[int, int]
    colormaps: tuple[Any, ...]
    limits: tuple[tuple[float, float], ...]
    channels: tuple[str, ...]

    @classmethod
    def of(
        cls, layers: Sequence[Image], axes: str, origin: tuple[int, int], frames: range | None = None
    ) -> "Placement":
        """Note where the burst is; `axes` names the axes of each layer's data, `frames` those of them it is made of."""
        layer = layers[0]
        shape = (layer.data[0] if layer.multiscale else layer.data).shape
        sizes = dict(zip(axes, shape, strict=True))
        own = axes.replace("C", "") if layer.rgb else axes
        scale, translate = [float(value) for value in layer.scale], [float(value) for value in layer.translate]
        if frames is not None:
            sizes["T"], at = len(frames), own.index("T")
            translate[at] += scale[at] * frames.start
            scale[at] *= frames.step
        # Axes of length 1 in front are the viewer's to fill in.
        first = next(position for position, axis in enumerate(own) if axis in "TYXC")
        return cls(
            axes=own[first:],
            sizes=sizes,
            rgb=layer.rgb,
            scale=tuple(scale[first:]),
            translate=tuple(translate[first:]),
            units=tuple(layer.units[first:]),
            axis_labels=tuple(layer.axis_labels[first:]),
            world_from_data=_world_from_data(layer),
            origin=origin,
            colormaps=tuple(None if one.rgb else one.colormap for one in layers),
            limits=tuple((float(one.contrast_limits[0]), float(one.contrast_limits[1])) for one in layers),
            channels=tuple(one.name for one in layers) if len(layers) > 1 else (),
        )

    def arrange(self, array: Any, have: str) -> tuple[Any, str]:
        """Put an array's axes `have` into the layer's order; return it and the axes it has now.

        Axes that it lacks are left out where they would come first, because layers broadcast along those, and are
        repeated without copying anywhere else.
        """
        wanted = self.axes
        if "T" in have and "T" not in wanted:  # of one frame, in a layer without time
            array, have = array[(slice(None),) * have.index("T") + (0,)], have.replace("T", "")
        while wanted and wanted[0] not in have:
            wanted = wanted[1:]
        ordered = array.transpose([have.index(axis) for axis in wanted if axis in have])
        for position, axis in enumerate(wanted):
            if axis not in have:
                shape = (*ordered.shape[:position], self.sizes[axis], *ordered.shape[position:])
                ordered = np.broadcast_to(np.expand_dims(ordered, position), shape)
        return ordered, wanted

    def parts(self, image: NDArray[np.float32], acquisition: Acquisition) -> list[tuple[str, NDArray[np.float32], str]]:
        """Return kind, data and axes of each layer that an image in intensity units, (H, W) or (H, W, C), takes."""
        if self.channels:
            return [
                (f"image of {name}", *self.arrange(image[..., number], "YX"))
                for number, name in enumerate(self.channels)
            ]
        if self.rgb:
            return [("image", as_colour(image, acquisition), "YX")]
        return [("image", *self.arrange(image, "YXC"[: image.ndim]))]

    def on_canvas(self, axes: str, canvas: Canvas | None = None) -> dict[str, Any]:
        """Return napari's scale, translate, units and axis labels for an array with these axes.

        Parameters
        ----------
        axes : str
            Of the array, as `arrange` returns them.
        canvas : Canvas, optional
            Where its rows and columns are in frame-0 pixels; default, they are a frame's.
        """
        step, first = np.ones(2), np.array(self.origin, dtype=np.float64)
        if canvas is not None:
            step = canvas.reference_from_image[[1, 0], [1, 0]]
            first = first + canvas.reference_from_image[[1, 0], [2, 2]]
        at = [self.axes.index(axis) for axis in axes]
        scale, translate = (np.array(value)[at] for value in (self.scale, self.translate))
        rows_and_columns = [axes.index("Y"), axes.index("X")]
        kept = {
            "units": tuple(self.units[axis] for axis in at),
            "axis_labels": tuple(self.axis_labels[axis] for axis in at),
        }
        if self.world_from_data is not None:
            placed = self.world_from_data @ np.array([[step[0], 0, first[0]], [0, step[1], first[1]], [0, 0, 1]])
            whole = np.diag([*scale, 1.0])
            whole[:-1, -1] = translate
            for row, own in zip(rows_and_columns, placed[:2], strict=True):
                whole[row] = 0
                whole[row, [*rows_and_columns, -1]] = own
            return {"affine": whole, **kept}
        translate[rows_and_columns] += scale[rows_and_columns] * first
        scale[rows_and_columns] *= step
        return {"scale": tuple(scale), "translate": tuple(translate), **kept}

    def frame_at(self, point: Sequence[float]) -> int | None:
        """Return the frame at a point of the viewer, in world coordinates; None where there is none."""
        if "T" not in self.axes or len(point) < len(self.axes):
            return None
        axis = self.axes.index("T")
        at = point[len(point) - len(self.axes) + axis]
        frame = round((at - self.translate[axis]) / self.scale[axis])
        return frame if 0 <= frame < self.sizes["T"] else None

    def pixel_at(self, point: Sequence[float]) -> tuple[int, int]:
        """Return row and column of the pixel at a point of one of its layers, in that layer's own coordinates."""
        axes = self.axes[-len(point) :]  # as `arrange` leaves them
        return round(float(point[axes.index("Y")])), round(float(point[axes.index("X")]))

    def vertices(self, points: NDArray[np.float64], frame: int) -> list[NDArray[np.float64]]:
        """Return frame-0 points (N, 2) as (x, y) in the axes of a layer of shapes, once per position of other axes.

        Shapes and tracks have every axis of the burst's layer, so that they follow its slider.
        """
        others = [axis for axis in self.axes if axis not in "TYX"]
        found = []
        for position in np.ndindex(*(self.sizes[axis] for axis in others)):
            fixed = {"T": frame, **dict(zip(others, position, strict=True))}
            own = {**fixed, "Y": points[:, 1], "X": points[:, 0]}
            found.append(np.stack([np.broadcast_to(own[axis], len(points)) for axis in self.axes], axis=1))
        return [vertices.astype(np.float64) for vertices in found]


def as_colour(image: NDArray[np.float32], acquisition: Acquisition) -> NDArray[np.float32]:
    """Return an RGB image in intensity units as RGBA in [0, 1], see-through where it is NaN."""
    span = acquisition.white_level - acquisition.black_level
    known = np.isfinite(image).all(axis=-1, keepdims=True)
    scaled = np.clip((image - acquisition.black_level) / span, 0, 1)
    return np.concatenate([np.where(known, scaled, 0), known], axis=-1, dtype=np.float32)


def _world_from_data(layer: Image) -> NDArray[np.float64] | None:
    rows = np.array([layer.data_to_world((*[0.0] * (layer.ndim - 2), *yx))[-2:] for yx in ((0, 0), (1, 0), (0, 1))])
    matrix = np.eye(3)
    matrix[:2, 2] = rows[0]
    matrix[:2, :2] = (rows[1:] - rows[0]).T
    plain = np.diag([layer.scale[-2], layer.scale[-1], 1.0])
    plain[:2, 2] = layer.translate[-2:]
    return None if np.allclose(matrix, plain) else matrix
