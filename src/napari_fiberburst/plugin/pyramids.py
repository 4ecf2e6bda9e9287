"""OME-Zarr results as layers: read at the zoom that is shown, and while they are still being written."""

from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import zarr
from napari.layers import Image

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.io.picture import limits_of
from napari_fiberburst.plugin.placement import Placement

# Contrast of a stack is told by so many of its pictures.
_LOOKED_AT = 8


class PyramidLayer:
    """A layer of an OME-Zarr image or video.

    Parameters
    ----------
    path : Path
        Of the image.
    name : str
        Of the layer.
    placement : Placement
        Where the frames lie, whose scale and units it gets.
    acquisition : Acquisition
        Of the recording that it was made of.
    metadata : dict
        Of the layer.

    Attributes
    ----------
    layer : Image
        To be added to a viewer.
    """

    def __init__(
        self, path: Path, name: str, placement: Placement, acquisition: Acquisition, metadata: dict[str, Any]
    ) -> None:
        count = sum(1 for _ in zarr.open_group(path, mode="r").array_keys())
        self._levels = [zarr.open_array(path / str(level), mode="r") for level in range(count)]
        # zarr's own arrays, because dask's are kept in napari's cache, which knows nothing of tiles that come later.
        data: list[Any] = list(self._levels)
        names = getattr(self._levels[0].metadata, "dimension_names", None) or ()
        is_colour = "c" in names and acquisition.shape[3] == 3
        if is_colour:
            data = [_as_colour(level, acquisition) for level in self._levels]
        axes = "".join(str(axis) for axis in names if not (is_colour and axis == "c")).upper()
        where = placement.on_canvas("YX")
        more = len(axes) - 2
        self.layer = Image(
            data if len(data) > 1 else data[0],
            multiscale=len(data) > 1,
            rgb=is_colour,
            cache=False,
            name=name,
            metadata=metadata,
            # Left to itself, napari looks for them in all that there is.
            contrast_limits=(0.0, 1.0),
            axis_labels=tuple(axes.lower()),
            **_with_more(where, more),
        )
        self._limits: tuple[float, ...] | None = tuple(self.layer.contrast_limits)
        self._fit_contrast()

    def refresh(self) -> None:
        """Show what has been written since."""
        self._fit_contrast()
        if self.layer.multiscale:
            # napari keeps the coarsest level, which thumbnails are made of, until it is given data anew.
            self.layer.data = list(self.layer.data)
        else:
            self.layer.refresh()

    def _fit_contrast(self) -> None:
        """Let the contrast follow what is there, until the user takes it in hand."""
        layer = self.layer
        if layer.rgb or self._limits != tuple(layer.contrast_limits):
            return
        coarse = self._levels[-1]
        if coarse.ndim > 2:
            numbers = sorted({round(at) for at in np.linspace(0, coarse.shape[0] - 1, _LOOKED_AT).tolist()})
            seen = np.stack([np.asarray(coarse[number]) for number in numbers])
        else:
            seen = np.asarray(coarse[:])
        low, high = limits_of(seen)
        if np.isfinite(seen).any() and high > low:
            layer.contrast_limits_range = (low, high)
            layer.contrast_limits = (low, high)
            self._limits = tuple(layer.contrast_limits)


def _as_colour(level: Any, acquisition: Acquisition) -> da.Array:
    """Return a level, (..., 3, H, W) in the recording's units, as RGBA in [0, 1], see-through where it is NaN."""
    values = da.moveaxis(da.from_array(level, chunks=level.chunks), -3, -1)
    span = acquisition.white_level - acquisition.black_level
    known = da.isfinite(values).all(axis=-1, keepdims=True)
    scaled = da.clip((values - acquisition.black_level) / span, 0, 1)
    return da.concatenate([da.where(known, scaled, 0), known], axis=-1).astype(np.float32)


def _with_more(where: dict[str, Any], more: int) -> dict[str, Any]:
    """Return napari's placing of rows and columns for an array with so many axes before them."""
    if "affine" in where:
        affine = np.eye(more + 3)
        affine[more:, more:] = where["affine"]
        placed: dict[str, Any] = {"affine": affine}
    else:
        placed = {"scale": (1.0,) * more + where["scale"], "translate": (0.0,) * more + where["translate"]}
    return {**placed, "units": ("pixel",) * more + tuple(where["units"])}
