"""From napari's layers to a burst: which axis is which, what is known of the pixels, and where the truth lies."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import tifffile
from napari.layers import Image, Shapes
from numpy.typing import NDArray

from napari_fiberburst.data.burst import MIN_SIDE, Burst
from napari_fiberburst.errors import BurstError, FiberBurstError
from napari_fiberburst.io.tiff import TIFF_ENDINGS
from napari_fiberburst.plugin import METADATA_KEY, RECORDING_KEY
from napari_fiberburst.plugin.scrubbing import Frames

_LABELS = {"t": "T", "time": "T", "frame": "T", "c": "C", "channel": "C", "y": "Y", "x": "X", "z": "Z"}
_PIXEL_UNITS = ("pixel", "dimensionless")
Region = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What a simulated burst knows of itself.

    Attributes
    ----------
    image : numpy.ndarray
        (H, W, C) float32 in [0, 1], frame 0 without bundle and noise.
    homographies : numpy.ndarray
        (T, 3, 3), frame-t pixel to frame-0 pixel.
    """

    image: NDArray[np.float32]
    homographies: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class BurstSource:
    """A burst as the layers hold it; nothing is copied or computed until `read`.

    Attributes
    ----------
    names : tuple of str
        The layers.
    arrays : tuple of array
        Their data, numpy or dask.
    axes : str
        Order of the axes of each array, such as "TYX", "TYXC" or "CTYX"; one frame has no T.
    region : ((int, int), (int, int)) or None
        Rows and columns, half-open, of the part that is used.
    chosen : range or None
        The frames of the layers that the arrays hold; None where they hold all.
    pixel_size : (float, float) or None
        Height and width of a pixel, in `unit`.
    unit : str or None
        Unit of length.
    channel_names : tuple of str
        One per channel; empty where they are not known.
    times : tuple of float or None
        Seconds at which the frames were taken.
    words : tuple of str
        How each array is called in napari's console.
    path : str or None
        The file that holds it just as it is.
    recipe : dict
        How a simulated burst was made; empty for others.
    truth : Truth or None
        Of the whole frame.
    """

    names: tuple[str, ...]
    arrays: tuple[Any, ...]
    axes: str
    region: Region | None = None
    chosen: range | None = None
    pixel_size: tuple[float, float] | None = None
    unit: str | None = None
    channel_names: tuple[str, ...] = ()
    times: tuple[float, ...] | None = None
    words: tuple[str, ...]
    path: str | None = None
    recipe: dict[str, Any]
    truth: Truth | None = None

    @property
    def name(self) -> str:
        """The layers' names in one."""
        return " + ".join(self.names)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(T, H, W, C) of the burst, by the axes given; without T it is one frame.

        Raises
        ------
        BurstError
            The axes do not fit the data.
        """
        data = self.arrays[0]
        if len(self.axes) != data.ndim or len(set(self.axes)) != data.ndim or not {"Y", "X"} <= set(self.axes):
            raise BurstError(
                f"a burst needs the axes T, Y, X and perhaps C; layer {self.names[0]!r} has shape "
                f"{tuple(data.shape)} with axes {self.axes or 'unknown'}; open the frames as one stack, or correct "
                "the order of the axes"
            )
        sizes = dict(zip(self.axes, data.shape, strict=True))
        long = [axis for axis, size in sizes.items() if axis not in "TYXC" and size != 1]
        if long:
            raise BurstError(
                f"axis {long[0]} of {self.axes} must have length 1, got {sizes[long[0]]}; take one position of it, or "
                "call it T or C"
            )
        height, width = (
            (stop - start for start, stop in self.region) if self.region is not None else (sizes["Y"], sizes["X"])
        )
        return sizes.get("T", 1), height, width, sizes.get("C", 1) if len(self.arrays) == 1 else len(self.arrays)

    @property
    def frames(self) -> Any:
        """The burst as it came, (T, H, W) or (T, H, W, C), the region alone; lazy where the layer's data are."""
        if self.region is None:
            return self.whole
        (y0, y1), (x0, x1) = self.region
        return self.whole[:, y0:y1, x0:x1]

    def read(self) -> Burst:
        """Make the burst; may take as long as reading the file does.

        Raises
        ------
        BurstError
            The layers are no usable burst.
        """
        burst = Burst(
            self.whole,
            channel_names=self.channel_names,
            pixel_size=self.pixel_size,
            unit=self.unit,
            times=self.times,
        )
        return burst if self.region is None else burst.crop(*self.region)

    def take(self, frames: range) -> "BurstSource":
        """Return a burst of these frames of the layers, still unread."""
        at = self.axes.index("T")
        part = (slice(None),) * at + (_slice(frames),)
        inner = f"[{', '.join([*[':'] * at, _written(frames)])}]"
        return replace(
            self,
            arrays=tuple(
                array.take(frames) if isinstance(array, Frames) and at == 0 else array[part] for array in self.arrays
            ),
            chosen=frames,
            times=None if self.times is None else self.times[_slice(frames)],
            words=tuple(word + inner for word in self.words),
            path=None,
            recipe={},
            truth=None,
        )

    def some(self, frames: Sequence[int], rows: tuple[int, int], columns: tuple[int, int]) -> "BurstSource":
        """Return the burst of some frames, and of these rows and columns, half-open, of what is used of them."""
        (y0, _), (x0, _) = self.region or ((0, 0), (0, 0))
        at = self.axes.find("T")
        taken = self.arrays if at < 0 else tuple(array[(slice(None),) * at + (list(frames),)] for array in self.arrays)
        region = ((y0 + rows[0], y0 + rows[1]), (x0 + columns[0], x0 + columns[1]))
        return replace(self, arrays=taken, region=region, times=None, truth=None)

    @property
    def whole(self) -> Any:
        """Return all of every frame, (T, H, W) or (T, H, W, C), in the layers' own type."""
        axes, data = self.axes, self.arrays[0]
        if len(self.arrays) > 1:
            if "C" in axes or any(array.shape != data.shape for array in self.arrays):
                shapes = [f"{name} {tuple(array.shape)}" for name, array in zip(self.names, self.arrays, strict=True)]
                raise BurstError(
                    f"layers that are channels of one burst must be grey and of one shape; got {', '.join(shapes)}"
                )
            axes, data = axes + "C", np.stack(self.arrays, axis=-1)
        for axis in [axis for axis in axes if axis not in "TYXC"]:
            data, axes = data[(slice(None),) * axes.index(axis) + (0,)], axes.replace(axis, "")
        if isinstance(data, Frames):
            data = np.asarray(data)
        ordered = data.transpose([axes.index(axis) for axis in "TYXC" if axis in axes])
        return ordered if "T" in axes else ordered[None]


def _slice(frames: range) -> slice:
    return slice(frames.start, frames.stop if frames.stop >= 0 else None, frames.step)


def _written(frames: range) -> str:
    """Return a range as Python writes a slice."""
    return f"{frames.start}:{frames.stop}" + (f":{frames.step}" if frames.step != 1 else "")


def source_of(layers: Sequence[Image], axes: str, region: Region | None = None) -> BurstSource:
    """Describe the burst that lies in one layer, or in one layer for each channel."""
    first = layers[0]
    metadata = first.metadata.get(METADATA_KEY, {}) if len(layers) == 1 else {}
    truth = _truth(metadata, data_of(first), axes)
    recording = first.metadata.get(METADATA_KEY, {}).get(RECORDING_KEY, {})
    pixel_size, unit = _pixel_size(first, axes)
    if pixel_size is None:
        pixel_size, unit = recording.get("pixel_size"), recording.get("unit")
    sizes = dict(zip(axes, data_of(first).shape, strict=False))
    names, times = recording.get("channel_names", ()), recording.get("times", ())
    if len(layers) > 1:
        names, sizes["C"] = [layer.name for layer in layers], len(layers)
    return BurstSource(
        names=tuple(layer.name for layer in layers),
        arrays=tuple(data_of(layer) for layer in layers),
        axes=axes,
        region=region,
        pixel_size=pixel_size,
        unit=unit,
        # Of no use where the data or the order of the axes have been changed since.
        channel_names=tuple(names) if len(names) == sizes.get("C", 1) else (),
        times=tuple(times) if times and len(times) == sizes.get("T") else None,
        words=tuple(words_of(layer) for layer in layers),
        path=_path(first, metadata) if len(layers) == 1 else None,
        recipe={} if truth is None else dict(metadata.get("recipe", {})),
        truth=truth,
    )


def guess_axes(layer: Image) -> str:
    """Return the order of a layer's axes, a letter each, by its labels or else by its shape."""
    data = data_of(layer)
    labels = [_LABELS.get(label.lower(), "") for label in layer.axis_labels]
    if layer.rgb:
        return "TYXC"[-data.ndim :] if data.ndim <= 4 else "Q" * (data.ndim - 4) + "TYXC"
    if all(labels) and {"T", "Y", "X"} <= set(labels) and len(set(labels)) == data.ndim:
        return "".join(labels)
    if data.ndim != 4:
        # Axes of length 1 in front, as ImageJ's stacks have them, are dropped when the burst is read.
        return "QZTYX"[-data.ndim :] if data.ndim <= 5 else ""
    if data.shape[3] < MIN_SIDE:
        return "TYXC"
    return "TCYX" if data.shape[0] >= data.shape[1] else "CTYX"


def region_of(shapes: Shapes, burst: Image, axes: str) -> Region:
    """Return rows and columns of the burst inside the rectangle that is selected, or drawn last.

    Raises
    ------
    FiberBurstError
        There is no shape, or it lies outside the frame, or is too small.
    """
    if not len(shapes.data):
        raise FiberBurstError(f"layer {shapes.name!r} holds no rectangle; draw one, or choose no region")
    if axes.replace("C", "" if burst.rgb else "C")[-2:] != "YX":
        raise FiberBurstError("a region needs the burst's last two axes to be Y and X; choose no region")
    chosen = max(shapes.selected_data, default=len(shapes.data) - 1)
    corners = np.array([shapes.data_to_world(vertex)[-2:] for vertex in shapes.data[chosen]])
    inside = np.array([burst.world_to_data((*[0.0] * (burst.ndim - 2), *corner))[-2:] for corner in corners])
    sizes = dict(zip(axes, data_of(burst).shape, strict=True))
    (y0, x0), (y1, x1) = np.rint(inside.min(axis=0)).astype(int), np.rint(inside.max(axis=0)).astype(int) + 1
    rows, columns = (max(y0, 0), min(y1, sizes["Y"])), (max(x0, 0), min(x1, sizes["X"]))
    if min(rows[1] - rows[0], columns[1] - columns[0]) < MIN_SIDE:
        raise FiberBurstError(
            f"the region must cover at least {MIN_SIDE} x {MIN_SIDE} pixels of the frame; it covers rows "
            f"{rows[0]} to {rows[1]} and columns {columns[0]} to {columns[1]}; draw a larger rectangle"
        )
    return (int(rows[0]), int(rows[1])), (int(columns[0]), int(columns[1]))


def data_of(layer: Image) -> Any:
    """Return a layer's array at full resolution, without the alpha channel of an RGBA image."""
    data = layer.data[0] if layer.multiscale else layer.data
    return data[..., :3] if layer.rgb and data.shape[-1] == 4 else data


def _pixel_size(layer: Image, axes: str) -> tuple[tuple[float, float] | None, str | None]:
    """Return height and width of a pixel and their unit, where the layer has a unit of length."""
    spatial = axes.replace("C", "") if layer.rgb else axes
    if not {"Y", "X"} <= set(spatial) or len(spatial) != layer.ndim:
        return None, None
    at = [spatial.index(axis) for axis in "YX"]
    units = {str(layer.units[axis]) for axis in at}
    if len(units) != 1 or units & set(_PIXEL_UNITS):
        return None, None
    height, width = np.linalg.norm(layer.affine.linear_matrix * layer.scale, axis=0)[at].tolist()
    return (height, width), f"{layer.units[at[0]]:~}"


def _truth(metadata: dict[str, Any], data: Any, axes: str) -> Truth | None:
    """Return the truth that a layer carries, if its data are still those it is the truth of."""
    if "truth" not in metadata or "homographies" not in metadata:
        return None
    frames, height, width, channels = metadata["truth"].shape
    order = "TYXC" if len(axes) == 4 else "TYX"
    if (
        axes != order
        or data.shape != (frames, height, width, channels)[: len(order)]
        or (data.ndim == 3) != (channels == 1)
    ):
        return None
    return Truth(image=metadata["truth"][0], homographies=metadata["homographies"])


def _path(layer: Image, metadata: dict[str, Any]) -> str | None:
    """Return the file that reads as this layer; not one that holds other frames or channels too, or did once."""
    path, shape = layer.source.path, data_of(layer).shape
    if "shape" in metadata:  # by the reader of this plugin
        return str(metadata["burst_path"]) if tuple(metadata["shape"]) == shape else None
    if path is None or not str(path).lower().endswith(TIFF_ENDINGS):
        return None
    try:
        with tifffile.TiffFile(path) as file:
            return str(path) if file.series[0].shape == shape else None
    except (OSError, ValueError, IndexError):
        return None


def words_of(layer: Image) -> str:
    """Return how the array of `data_of` is called in napari's console."""
    alpha = layer.rgb and (layer.data[0] if layer.multiscale else layer.data).shape[-1] == 4
    return f"viewer.layers[{layer.name!r}].data{'[0]' if layer.multiscale else ''}{'[..., :3]' if alpha else ''}"
