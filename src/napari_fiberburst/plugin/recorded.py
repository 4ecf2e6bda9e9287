"""What the file of a layer says of its recording, which napari's own reader of TIFF does not hand on."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from napari.components import ViewerModel
from napari.layers import Image

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.recording import Recording
from napari_fiberburst.io.tiff import TIFF_ENDINGS, describe_tiff
from napari_fiberburst.plugin import METADATA_KEY, RECORDING_KEY


def take_recording(viewer: ViewerModel, layer: Image, axes: str) -> None:
    """Note what a layer's file says, once; the layer gets its pixel size where no other layer is then out of place.

    Parameters
    ----------
    viewer : ViewerModel
        Where the layer is.
    layer : Image
        As it was opened.
    axes : str
        A letter for each axis of its data.
    """
    known = layer.metadata.get(METADATA_KEY, {})
    path = layer.source.path
    if RECORDING_KEY in known or path is None or not str(path).lower().endswith(TIFF_ENDINGS):
        return
    try:
        told = describe_tiff(Path(path))
    except BurstError:
        return  # the file has changed since: the pixels are here, and good
    found = Recording(pixels=layer.data, axes=axes, **told).usable_metadata(axes)
    layer.metadata = {**layer.metadata, METADATA_KEY: {**known, RECORDING_KEY: found}}
    if "pixel_size" in found and "unit" in found and _is_as_opened(layer) and not _would_part(viewer, layer):
        _scale(layer, axes, found)
        viewer.reset_view()


def _scale(layer: Image, axes: str, found: dict[str, Any]) -> None:
    own = axes.replace("C", "") if layer.rgb else axes
    if len(own) != layer.ndim:
        return
    sizes = dict(zip("YX", found["pixel_size"], strict=True))
    with suppress(ValueError):  # a unit of length that napari does not know
        layer.units = tuple(found["unit"] if axis in sizes else "pixel" for axis in own)
        layer.scale = tuple(sizes.get(axis, 1.0) for axis in own)


def _is_as_opened(layer: Image) -> bool:
    """Whether nobody has given a layer a scale or a unit."""
    return all(step == 1 for step in layer.scale) and {str(unit) for unit in layer.units} == {"pixel"}


def _would_part(viewer: ViewerModel, layer: Image) -> bool:
    """Whether another layer lies over this one in pixels, and would not when this one has a length for them."""
    return any(other is not layer and str(other.units[-1]) == "pixel" for other in viewer.layers)
