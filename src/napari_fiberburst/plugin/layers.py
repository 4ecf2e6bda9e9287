"""The layers of one run: the image while it resolves, how the frames lie on it, and what it rests on."""

import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from napari.components import ViewerModel
from napari.layers import Image, Layer, Shapes, Tracks, Vectors
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.plugin import METADATA_KEY
from napari_fiberburst.plugin.placement import COLOUR_LIMITS, Placement, as_colour, limits_of
from napari_fiberburst.plugin.stacks import Flow, bending, moved_points, residual_maps, stabilised

if TYPE_CHECKING:
    from napari_fiberburst.data.canvas import Canvas
    from napari_fiberburst.results.reconstruction import Reconstruction

# Outlines are drawn anew at most this often, because a layer of shapes is slow to add and to change.
_SECONDS_BETWEEN_OUTLINES = 5.0
# ... and then take at most this part of the time.
_OUTLINES_SHARE = 0.05
_OUTLINES, _CENTRES = "frame outlines", "frame centres"
_EDGE, _TRACK_COLOURS = "#ffb000", "turbo"
# Outlines of frames that bend have so many points a side; arrows that show how, so many along the frame's longer side,
# and are so much longer than the way they show.
_PER_SIDE, _ARROWS, _ENLARGED = 12, 16, 3.0
_ARROWS_NAME = "bending"
# An outline is as wide as this part of the frame.
_FRAME_PER_EDGE = 200
# Above this one, residuals are shown in the brightest colour.
_RESIDUAL_PERCENTILE = 99.0


class RunLayers:
    """Adds a run's layers to a viewer and keeps them up to date; those that a user deletes stay deleted.

    Parameters
    ----------
    viewer : ViewerModel
        Where to.
    name : str
        The run's, in front of each layer's name.
    placement : Placement
        Where the burst is.
    metadata : mapping
        What to write into each layer's metadata.
    """

    def __init__(self, viewer: ViewerModel, name: str, placement: Placement, metadata: Mapping[str, Any]) -> None:
        self._viewer, self._name, self.placement = viewer, name, placement
        self._common = dict(metadata)
        self._layers: dict[str, Layer] = {}
        self._is_removed = False
        self._drawn_at: NDArray[np.float64] | None = None
        self._limits: dict[str, tuple[float, float]] = {}
        self._outlined = self._outlining = 0.0

    @property
    def images(self) -> list[Layer]:
        """The layers of the image that are still in the viewer."""
        return [layer for kind, layer in self._layers.items() if _is_image(kind) and self._has(layer)]

    @property
    def _has_time(self) -> bool:
        """Whether the burst's layer has an axis of frames; the image of one frame alone lies where the frame does."""
        return "T" in self.placement.axes

    def show_image(self, image: NDArray[np.float32], acquisition: Acquisition, canvas: "Canvas") -> None:
        """Show an image (H, W) or (H, W, C) in intensity units, in the layers that are there for it, or new ones."""
        for number, (kind, data, axes) in enumerate(self._parts(image, acquisition)):
            placed = self.placement.on_canvas(axes, canvas)
            layer = self._layers.get(kind)
            if layer is None:
                self._add_image(kind, data, placed, self.placement.colormaps[number])
                self._outlined = time.perf_counter()
            elif self._has(layer):
                if self._drawn_at is None or not np.array_equal(self._drawn_at, canvas.reference_from_image):
                    for attribute, value in placed.items():
                        setattr(layer, attribute, value)
                self._fit_contrast(kind, layer, data)
                layer.data = data
        self._drawn_at = canvas.reference_from_image

    def show_frames(self, homographies: NDArray[np.float64], shape: tuple[int, int]) -> None:
        """Show, now and then, where each frame (H, W) lies on the image: outlines, and a track of the centres."""
        wait = max(_SECONDS_BETWEEN_OUTLINES, self._outlining / _OUTLINES_SHARE)
        # The first layer of shapes can take seconds to come: the image goes first, and is seen.
        if not self._layers or time.perf_counter() - self._outlined < wait:
            return
        began, before = time.perf_counter(), len(self._layers)
        for _ in self._put_frames(homographies, shape):
            if len(self._layers) > before:
                break  # the other layer next time: each new one holds up the window
        self._outlined = time.perf_counter()
        self._outlining = self._outlined - began

    def finish(self, result: "Reconstruction", frames: Any) -> Iterator[None]:
        """Show the result and all that it rests on, a layer at a time, so that the window is never held up for long.

        Parameters
        ----------
        result : Reconstruction
            What has come of the run.
        frames : array
            The burst as it came, (T, H, W) or (T, H, W, C).

        Yields
        ------
        None
            After each layer.
        """
        self._common["homographies"] = result.homographies
        canvas, shape = result.canvas, result.acquisition.shape[1:3]
        self.show_image(result.image, result.acquisition, canvas)
        for kind, layer in self._layers.items():
            # napari keeps layers of shapes that have been removed: what is large goes with the image alone.
            layer.metadata = self._metadata({"reconstruction": result} if _is_image(kind) else {})
        yield
        flow = result.flow if result.bends else None
        yield from self._put_frames(result.homographies, shape, flow)
        if self._has_time:
            still = stabilised(frames, result.homographies, canvas, flow)
            if self.placement.rgb:
                self._add("stabilised burst", still, "TYX", canvas, rgb=True, contrast_limits=self.placement.limits[0])
            else:
                look = {"colormap": self.placement.colormaps[0], "contrast_limits": self.placement.limits[0]}
                self._add("stabilised burst", still, "TYXC"[: still.ndim], canvas, **look)
            yield
        self._add("coverage", result.coverage, "YX", canvas, colormap="viridis")
        yield
        self._add("frames behind each pixel", result.context, "YX", canvas, colormap="viridis")
        yield
        self._add("uncertainty", result.uncertainty, "YX", canvas, colormap="magma")
        yield
        bundle = result.bundle
        if bundle is None:
            return
        self._add("transmission", bundle.transmission, "YX")
        yield
        if result.residuals is not None and bundle.is_resolved and np.isfinite(result.residuals).any():
            maps = residual_maps(result.residuals, bundle.labels)
            high = float(np.nanpercentile(result.residuals, _RESIDUAL_PERCENTILE))
            self._add("residuals", maps, "TYX", colormap="inferno", contrast_limits=(0.0, high or 1.0))
        if result.outliers is not None and bundle.is_resolved and result.outliers.any():
            yield
            maps = residual_maps(result.outliers.astype(np.float32), bundle.labels)
            # Over the frames, which show what was left out.
            self._add("left out", maps, "TYX", colormap="magenta", contrast_limits=(0.0, 1.0), blending="additive")

    def tell(self, name: str, value: Any) -> None:
        """Write something more into the metadata of all layers of the run."""
        self._common[name] = value
        for layer in self._layers.values():
            layer.metadata = {METADATA_KEY: {**layer.metadata.get(METADATA_KEY, {}), name: value}}

    def rename(self, name: str) -> None:
        """Give the run's layers another name in front."""
        self._name = name
        self.tell("run", name)
        for kind, layer in self._layers.items():
            layer.name = f"{name}: {kind}"

    def set_visible(self, kind: str, visible: bool) -> None:
        """Show or hide one kind of layer, where it still is."""
        for name, layer in self._layers.items():
            if name.startswith(kind) and self._has(layer):
                layer.visible = visible

    def remove(self) -> None:
        """Take all layers of the run out of the viewer, for good."""
        self._is_removed = True
        for layer in self._layers.values():
            if self._has(layer):
                self._viewer.layers.remove(layer)
        self._layers.clear()

    def _parts(
        self, image: NDArray[np.float32], acquisition: Acquisition
    ) -> list[tuple[str, NDArray[np.float32], str]]:
        """Return kind, data and axes of each layer that the image takes."""
        if self.placement.channels:
            return [
                (f"image of {name}", *self.placement.arrange(image[..., number], "YX"))
                for number, name in enumerate(self.placement.channels)
            ]
        if self.placement.rgb:
            return [("image", as_colour(image, acquisition), "YX")]
        return [("image", *self.placement.arrange(image, "YXC"[: image.ndim]))]

    def _add_image(self, kind: str, data: NDArray[np.float32], placed: dict[str, Any], colormap: Any) -> None:
        # Left to itself, napari takes the limits of the first image, which of a network is nearly even.
        more: dict[str, Any] = {"contrast_limits": COLOUR_LIMITS} if self.placement.rgb else {"colormap": colormap}
        limits = limits_of(data)
        if limits is not None and not self.placement.rgb:
            more["contrast_limits"] = limits
        if self.placement.channels:
            more["blending"] = "additive"
        self._insert(kind, Image(data, rgb=self.placement.rgb, **placed, **more))
        if kind in self._layers and not self.placement.rgb:
            self._limits[kind] = tuple(self._layers[kind].contrast_limits)

    def _fit_contrast(self, kind: str, layer: Image, data: NDArray[np.float32]) -> None:
        """Follow the image with the contrast, until the user takes it in hand."""
        limits = limits_of(data)
        if kind not in self._limits or limits is None or tuple(layer.contrast_limits) != self._limits[kind]:
            return
        layer.contrast_limits_range = limits
        layer.contrast_limits = limits
        self._limits[kind] = tuple(layer.contrast_limits)

    def _put_frames(
        self, homographies: NDArray[np.float64], shape: tuple[int, int], flow: Flow | None = None
    ) -> Iterator[None]:
        """Add or change the outlines, then the track, then arrows where frames bend; yields after each."""
        height, width = shape
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
        centre = corners.mean(axis=0, keepdims=True)
        known = [frame for frame, matrix in enumerate(homographies) if np.isfinite(matrix).all()]
        placed = self.placement.on_canvas(self.placement.axes)
        self._common["homographies"] = homographies
        if not (known and self._has_time):
            return
        flows = {frame: None if flow is None else flow(frame) for frame in known}
        sides = (
            corners if flow is None else np.linspace(corners, np.roll(corners, -1, axis=0), _PER_SIDE, axis=1)[:, :-1]
        )

        def vertices(points: NDArray[np.float64], frame: int) -> list[NDArray[np.float64]]:
            return self.placement.vertices(moved_points(points, homographies[frame], flows[frame]), frame)

        outlines = [one for frame in known for one in vertices(sides.reshape(-1, 2), frame)]
        if _OUTLINES not in self._layers:
            edge = {"edge_color": _EDGE, "edge_width": max(1.0, width / _FRAME_PER_EDGE), "face_color": "transparent"}
            self._insert(_OUTLINES, Shapes(outlines, shape_type="polygon", **edge, **placed))
        elif self._has(self._layers[_OUTLINES]):
            self._layers[_OUTLINES].data = outlines
        yield
        # One track for each position of axes that are neither time nor space.
        tracks = zip(*(vertices(centre, frame) for frame in known), strict=True)
        points = np.array([[number, *point[0]] for number, track in enumerate(tracks) for point in track])
        if _CENTRES not in self._layers:
            tail = {"tail_length": len(homographies), "colormap": _TRACK_COLOURS}
            self._insert(_CENTRES, Tracks(points, **tail, **placed))
        elif self._has(self._layers[_CENTRES]):
            self._layers[_CENTRES].data = points
        yield
        if flow is not None:
            self._put_arrows({frame: bending(flow(frame), homographies[frame], _ARROWS) for frame in known}, placed)
            yield

    def _put_arrows(self, arrows: Mapping[int, NDArray[np.float64]], placed: dict[str, Any]) -> None:
        """Add a hidden layer of arrows (N, 2, 2) for every frame: where it bends, and by how much, enlarged."""
        parts = []
        for frame, pairs in arrows.items():
            starts, ends = (self.placement.vertices(points, frame) for points in (pairs[:, 0], pairs.sum(axis=1)))
            parts += [np.stack([start, end - start], axis=1) for start, end in zip(starts, ends, strict=True)]
        look = {"length": _ENLARGED, "edge_color": _EDGE, "vector_style": "arrow", "visible": False}
        self._insert(_ARROWS_NAME, Vectors(np.concatenate(parts), **look, **placed))

    def _add(self, kind: str, array: Any, axes: str, canvas: "Canvas | None" = None, **look: Any) -> None:
        """Add a hidden layer beneath the image for something that comes with the result, where it came."""
        if array is None or kind in self._layers or self._is_removed:
            return
        if "C" in axes and self.placement.channels:
            for number, name in enumerate(self.placement.channels):
                self._add(f"{kind} of {name}", array[..., number], axes.replace("C", ""), canvas, **look)
            return
        data, axes = (array, axes) if look.get("rgb") else self.placement.arrange(array, axes)
        layer = Image(data, visible=False, **self.placement.on_canvas(axes, canvas), **look)
        at = [self._viewer.layers.index(image) for image in self.images]
        self._insert(kind, layer, min(at, default=len(self._viewer.layers)))

    def _insert(self, kind: str, layer: Layer, at: int | None = None) -> None:
        if self._is_removed:
            return
        layer.name = f"{self._name}: {kind}"
        layer.metadata = self._metadata()
        self._layers[kind] = layer
        layers = self._viewer.layers
        chosen = set(layers.selection)
        layers.insert(len(layers) if at is None else at, layer)
        # What the user works on stays selected.
        layers.selection = chosen or {layer}

    def _metadata(self, more: Mapping[str, Any] | None = None) -> dict[str, Any]:
        return {METADATA_KEY: {**self._common, **(more or {})}}

    def _has(self, layer: Layer) -> bool:
        return layer in self._viewer.layers


def _is_image(kind: str) -> bool:
    return kind.startswith("image")
