"""The layers of a live view: the picture, which stays where the newest frame is, and the mosaic about it."""

from typing import TYPE_CHECKING, Any

import numpy as np
from napari.components import ViewerModel
from napari.layers import Image
from numpy.typing import NDArray

from napari_fiberburst.io.picture import limits_of
from napari_fiberburst.plugin import METADATA_KEY

if TYPE_CHECKING:
    from napari_fiberburst.live.view import LiveView
    from napari_fiberburst.plugin.live_job import Pasted

# Contrast follows the picture for so many of them, in which it gets clear of the honeycomb.
_FOLLOWED = 40
_COLOURS = 3
_THUMBNAIL_EVERY = 30


class LiveLayers:
    """Adds the picture of a live view to a viewer, and keeps it up to date.

    Parameters
    ----------
    viewer : ViewerModel
        Where to.
    like : Image or None
        The layer that frames come from, which lies in the same place.

    Attributes
    ----------
    picture, mosaic : Image or None
        None before the first one.
    shown : int
        How many pictures have been.
    """

    def __init__(self, viewer: ViewerModel, like: Image | None) -> None:
        self._viewer = viewer
        self._place: dict[str, Any] = {}
        if like is not None:
            self._place = {
                "scale": tuple(like.scale[-2:]),
                "translate": tuple(like.translate[-2:]),
                "units": tuple(like.units[-2:]),
            }
        self.picture: Image | None = None
        self.mosaic: Image | None = None
        self._limits: tuple[float, float] | None = None
        self._count = self.shown = 0

    @property
    def is_removed(self) -> bool:
        """Whether a user has taken the picture out of the viewer."""
        return self.picture is not None and self.picture not in self._viewer.layers

    def show(self, view: "LiveView", *, in_mosaic: bool) -> None:
        """Show a picture, over the pixels of its frame, or where these lie in the mosaic."""
        data, rgb = self._as_shown(view.image)
        self.shown += 1
        if self.picture is None:
            more: dict[str, Any] = {} if rgb else {"contrast_limits": self._fitted(data)}
            self.picture = self._added(Image(data, name="live", rgb=rgb, **more, **self._placed(data, rgb)))
            self._viewer.reset_view()
        elif self.picture in self._viewer.layers:
            self._put_data(self.picture, data)
            if not rgb:
                self._fit_contrast(data, is_raw=view.state == "calibrating")
        if self.picture is not None:
            self._put(view.homography if in_mosaic else np.eye(3))

    def paste(self, pasted: "Pasted") -> None:
        """Show the mosaic, behind the picture."""
        data, rgb = self._as_shown(pasted.image)
        if self.mosaic is None and self.picture is not None:
            more = {} if rgb else {"contrast_limits": self.picture.contrast_limits}
            self.mosaic = self._added(Image(data, name="live mosaic", rgb=rgb, **more, **self._placed(data, rgb)))
            layers = self._viewer.layers
            if self.picture in layers:
                layers.move(layers.index(self.mosaic), layers.index(self.picture))
        elif self.mosaic is not None and self.mosaic in self._viewer.layers:
            self._put_data(self.mosaic, data)
            if not rgb and self.picture is not None:
                self.mosaic.contrast_limits = self.picture.contrast_limits
        if self.mosaic is not None:
            affine = np.eye(self.mosaic.ndim + 1)
            affine[-3:-1, -1] = pasted.origin
            self.mosaic.affine = self._in_world(affine)

    def _as_shown(self, image: NDArray[np.float32]) -> tuple[NDArray[np.float32], bool]:
        """Return a copy of an image (H, W) or (H, W, C) as a layer takes it, and whether it is shown as colour."""
        if image.ndim == 2 or image.shape[2] == 1:
            return image.reshape(image.shape[:2]).copy(), False
        if image.shape[2] != _COLOURS:
            return np.moveaxis(image, 2, 0).copy(), False
        known = np.isfinite(image).all(axis=2, keepdims=True)
        if self._limits is None or self._count < _FOLLOWED:
            self._limits = limits_of(image)
            self._count += 1
        low, high = self._limits
        scaled = np.clip((np.where(known, image, low) - low) / max(high - low, 1e-6), 0, 1)
        return np.concatenate([scaled, known], axis=2, dtype=np.float32), True

    def _fit_contrast(self, data: NDArray[np.float32], *, is_raw: bool) -> None:
        """Follow the picture with the contrast while it gets clear, until the user takes it in hand."""
        layer = self.picture
        if layer is None or self._count >= _FOLLOWED or tuple(layer.contrast_limits) != self._limits:
            return
        self._count += not is_raw
        limits = self._fitted(data)
        layer.contrast_limits_range = limits
        layer.contrast_limits = limits
        self._limits = tuple(layer.contrast_limits)

    def _fitted(self, data: NDArray[np.float32]) -> tuple[float, float]:
        low, high = limits_of(data)
        self._limits = (low, high if high > low else low + 1)
        return self._limits

    def _placed(self, data: NDArray[np.float32], rgb: bool) -> dict[str, Any]:
        """Return scale, translate and units for an image, and what tells that this plugin has made it."""
        further = data.ndim - (3 if rgb else 2)
        place = {
            name: ((1.0 if name == "scale" else 0.0 if name == "translate" else "pixel"),) * further + values
            for name, values in self._place.items()
        }
        return {**place, "metadata": {METADATA_KEY: {"run": "live"}}}

    def _put_data(self, layer: Image, data: NDArray[np.float32]) -> None:
        """Show other data. Other values of the same shape are written in place: napari takes half the time for that."""
        if data.shape != layer.data.shape:
            layer.data = data
            return
        layer.data[...] = data
        layer.refresh(thumbnail=self.shown % _THUMBNAIL_EVERY == 0, highlight=False, extent=False)

    def _put(self, homography: NDArray[np.float64]) -> None:
        """Move the picture to where its frame lies; what is left of a perspective is not drawn."""
        assert self.picture is not None
        affine = np.eye(self.picture.ndim + 1)
        affine[-3:-1, -3:-1] = homography[[1, 0]][:, [1, 0]]
        affine[-3:-1, -1] = homography[[1, 0], 2]
        wanted = self._in_world(affine)
        if not np.allclose(self.picture.affine.affine_matrix, wanted):
            self.picture.affine = wanted

    def _in_world(self, affine: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return an affine of pixels as one of the viewer's coordinates, which come after scale and translate."""
        world = np.eye(len(affine))
        for axis, step, first in zip(
            (-3, -2), self._place.get("scale", (1, 1)), self._place.get("translate", (0, 0)), strict=True
        ):
            world[axis, axis], world[axis, -1] = step, first
        return world @ affine @ np.linalg.inv(world)

    def _added(self, layer: Image) -> Image:
        chosen = set(self._viewer.layers.selection)
        self._viewer.layers.append(layer)
        self._viewer.layers.selection = chosen or {layer}
        return layer
