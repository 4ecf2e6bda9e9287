"""The layers of one run: the image, which resolves, and what it rests on, as far as that is switched on."""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from napari.components import ViewerModel
from napari.layers import Image, Layer
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.io.picture import limits_of
from napari_fiberburst.plugin import METADATA_KEY
from napari_fiberburst.plugin.evidence import (
    MOTION_KINDS,
    Motion,
    kinds_of,
    motion_layer,
    motion_of,
    outline_look,
    outlined_frames,
    outlines,
    path,
    result_layers,
)
from napari_fiberburst.plugin.placement import COLOUR_LIMITS, Placement

if TYPE_CHECKING:
    from napari_fiberburst.data.canvas import Canvas
    from napari_fiberburst.results.reconstruction import Reconstruction

# Outlines and path are drawn anew at most this often while a run goes, and take at most this part of the time.
_SECONDS_BETWEEN_OUTLINES, _OUTLINES_SHARE = 1.0, 0.05


class RunLayers:
    """Adds a run's image to a viewer, and what else is asked for, and keeps them up to date.

    An image that a user deletes stays deleted.

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
        self._places: dict[int, Layer] = {}
        self._is_removed = False
        self._drawn: NDArray[np.float32] | None = None
        self._drawn_at: NDArray[np.float64] | None = None
        self._limits: dict[str, tuple[float, float]] = {}
        self._outlined = self._outlining = 0.0
        self._motion: Motion | None = None
        self._result: Reconstruction | None = None
        self._frames: Any = None
        self._back: list[str] = []

    @property
    def is_removed(self) -> bool:
        """Whether the run was taken out of the viewer for good."""
        return self._is_removed

    @property
    def images(self) -> list[Layer]:
        """The layers of the image that are still in the viewer."""
        return [layer for kind, layer in self._layers.items() if _is_image(kind) and self._has(layer)]

    @property
    def shown(self) -> NDArray[np.float32] | None:
        """The image that they show, as it was given; None before the first one."""
        return self._drawn

    def show_image(self, image: NDArray[np.float32], acquisition: Acquisition, canvas: "Canvas") -> None:
        """Show an image (H, W) or (H, W, C) in intensity units, in the layers that are there for it, or new ones."""
        for number, (kind, data, axes) in enumerate(self.placement.parts(image, acquisition)):
            layer = self._layers.get(kind)
            if layer is None:
                self._insert(kind, image_layer(data, axes, self.placement, canvas, number))
                if kind in self._layers and not self.placement.rgb:
                    self._limits[kind] = tuple(self._layers[kind].contrast_limits)
            elif self._has(layer):
                if self._drawn_at is None or not np.array_equal(self._drawn_at, canvas.reference_from_image):
                    for attribute, value in self.placement.on_canvas(axes, canvas).items():
                        setattr(layer, attribute, value)
                self._fit_contrast(kind, layer, data)
                layer.data = data
        self._drawn, self._drawn_at = image, canvas.reference_from_image

    def show_frames(self, homographies: NDArray[np.float64], shape: tuple[int, int]) -> None:
        """Take in where each frame (H, W) lies on the image; where that is switched on, show it now and then."""
        self._motion = Motion(homographies=homographies, shape=shape)
        self._common["homographies"] = homographies
        began = time.perf_counter()
        if began - self._outlined >= max(_SECONDS_BETWEEN_OUTLINES, self._outlining / _OUTLINES_SHARE):
            self._put_motion()
            self._outlined = time.perf_counter()
            self._outlining = self._outlined - began

    def finish(self, result: "Reconstruction", frames: Any) -> None:
        """Show the image of a result, and let all that it rests on be switched on.

        Parameters
        ----------
        result : Reconstruction
            What has come of the run.
        frames : array
            The burst as it came, (T, H, W) or (T, H, W, C).
        """
        self._result, self._frames, self._motion = result, frames, motion_of(result)
        self._common["homographies"] = result.homographies
        self.show_image(result.image, result.acquisition, result.canvas)
        for kind, layer in self._layers.items():
            # napari keeps layers of shapes that have been removed: what is large goes with the image alone.
            layer.metadata = self._metadata({"reconstruction": result} if _is_image(kind) else {})
        self._put_motion()
        for kind in self._back:
            self.switch(kind, True)
        self._back = []

    def unfinish(self) -> None:
        """Take away what rests on a result that is no longer shown; what was on comes back with the next result."""
        self._back = [kind for kind in self.kinds if kind not in MOTION_KINDS and self.is_on(kind)]
        for kind in self._back:
            self.switch(kind, False)
        self._result = None
        for layer in self._layers.values():
            layer.metadata = self._metadata()

    def leave_out(self, frames: tuple[int, ...]) -> None:
        """Show which frames the image is made without."""
        if self._motion is not None:
            self._motion = replace(self._motion, left_out=frames)
            self._put_motion()

    def would_leave_some(self, frames: tuple[int, ...]) -> bool:
        """Whether any registered frame takes part without these."""
        return self._motion is not None and not set(self._motion.known) <= set(frames)

    def outlined_at(self, event: Any) -> int | None:
        """Return the frame on whose outline, or inside it, the mouse is; None where that is on none."""
        layer = self._layers.get("outlines")
        if layer is None or self._motion is None or not self._has(layer) or not layer.visible:
            return None
        at = {"view_direction": event.view_direction, "dims_displayed": event.dims_displayed}
        value = layer.get_value(event.position, **at, world=True)
        if value is None or value[0] is None:
            return None
        return outlined_frames(self._motion, self.placement)[int(value[0])]

    @property
    def kinds(self) -> tuple[str, ...]:
        """What can be switched on now, of `evidence.KINDS`."""
        if self._is_removed:
            return ()
        if self._result is not None:
            return kinds_of(self._result, self.placement)
        has_motion = self._motion is not None and bool(self._motion.known) and "T" in self.placement.axes
        return MOTION_KINDS if has_motion else ()

    def is_on(self, kind: str) -> bool:
        """Whether what a kind shows is in the viewer."""
        return any(_is_of(name, kind) and self._has(layer) for name, layer in self._layers.items())

    def switch(self, kind: str, on: bool) -> None:
        """Make the layers of a kind and show them, or take them away again."""
        if on == self.is_on(kind) or (on and kind not in self.kinds):
            return
        for name in [name for name in self._layers if _is_of(name, kind)]:
            layer = self._layers.pop(name)
            if self._has(layer):
                self._viewer.layers.remove(layer)
        if on and self._result is not None:
            for name, layer in result_layers(kind, self._result, self._frames, self.placement).items():
                self._insert(name, layer, self._above_images() if isinstance(layer, Image) else None)
        elif on and self._motion is not None:
            self._insert(kind, motion_layer(kind, self._motion, self.placement))

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
            if _is_of(name, kind) and self._has(layer):
                layer.visible = visible

    def take_out(self) -> None:
        """Take all layers of the run out of the viewer, until they are put back."""
        layers = self._viewer.layers
        self._is_removed = True
        self._places = {layers.index(layer): layer for layer in self._layers.values() if self._has(layer)}
        for layer in self._places.values():
            layers.remove(layer)

    def put_back(self) -> None:
        """Put the layers that were taken out back into their places."""
        self._is_removed = False
        for place, layer in sorted(self._places.items()):
            self._add(layer, min(place, len(self._viewer.layers)))
        self._places = {}

    def remove(self) -> None:
        """Take all layers of the run out of the viewer, for good."""
        self.take_out()
        self._layers.clear()
        self._places = {}
        self._result = self._frames = self._motion = self._drawn = None

    def _fit_contrast(self, kind: str, layer: Image, data: NDArray[np.float32]) -> None:
        """Follow the image with the contrast, until the user takes it in hand."""
        low, high = limits_of(data)
        if kind not in self._limits or high <= low or tuple(layer.contrast_limits) != self._limits[kind]:
            return
        layer.contrast_limits_range = (low, high)
        layer.contrast_limits = (low, high)
        self._limits[kind] = tuple(layer.contrast_limits)

    def _put_motion(self) -> None:
        """Bring outlines and path up to date, where they are shown."""
        motion = self._motion
        if motion is None or not motion.known:
            return
        for kind, draw in (("outlines", outlines), ("path", path)):
            if self.is_on(kind):
                self._layers[kind].data = draw(motion, self.placement)
        if self.is_on("outlines"):
            for name, value in outline_look(motion, self.placement).items():
                setattr(self._layers["outlines"], name, value)

    def _above_images(self) -> int:
        """Return the place in the list of layers above all of the run's images: what is new is seen."""
        layers = self._viewer.layers
        at = [layers.index(layer) for layer in self._layers.values() if isinstance(layer, Image) and self._has(layer)]
        return max(at, default=len(layers) - 1) + 1

    def _insert(self, kind: str, layer: Layer, at: int | None = None) -> None:
        if self._is_removed:
            return
        layer.name = f"{self._name}: {kind}"
        layer.metadata = self._metadata()
        self._layers[kind] = layer
        self._add(layer, len(self._viewer.layers) if at is None else at)

    def _add(self, layer: Layer, at: int) -> None:
        """Add a layer to the viewer; what the user works on stays selected."""
        layers = self._viewer.layers
        chosen = set(layers.selection)
        layers.insert(at, layer)
        layers.selection = chosen or {layer}

    def _metadata(self, more: Mapping[str, Any] | None = None) -> dict[str, Any]:
        return {METADATA_KEY: {**self._common, **(more or {})}}

    def _has(self, layer: Layer) -> bool:
        return layer in self._viewer.layers


def image_layer(data: NDArray[np.float32], axes: str, placement: Placement, canvas: "Canvas", number: int = 0) -> Image:
    """Make the layer of an image, or of one of its parts, as `Placement.parts` returns them."""
    more: dict[str, Any] = {"colormap": placement.colormaps[number]}
    # Left to itself, napari takes the limits of the first image, which of a network is nearly even.
    low, high = limits_of(data)
    if placement.rgb:
        more = {"contrast_limits": COLOUR_LIMITS}
    elif high > low:
        more["contrast_limits"] = (low, high)
    if placement.channels:
        more["blending"] = "additive"
    return Image(data, rgb=placement.rgb, **placement.on_canvas(axes, canvas), **more)


def _is_image(name: str) -> bool:
    return _is_of(name, "image")


def _is_of(name: str, kind: str) -> bool:
    """Whether a layer's name is that of a kind, or of one channel of it."""
    return name == kind or name.startswith(f"{kind} of ")
