"""A model as layers: its image, and what it rests on, as the dock shows them when a run has ended."""

from typing import TYPE_CHECKING, Any

import numpy as np
from napari.layers import Image, Layer

from napari_fiberburst.plugin import METADATA_KEY
from napari_fiberburst.plugin.evidence import kinds_of, result_layers
from napari_fiberburst.plugin.layers import image_layer
from napari_fiberburst.plugin.placement import Placement

if TYPE_CHECKING:
    from napari_fiberburst.results.reconstruction import Reconstruction

# What is made of the burst's own pixels, which a model does not hold.
_OF_FRAMES = ("stabilised burst",)


def model_layers(result: "Reconstruction", name: str, burst_look: dict[str, Any]) -> list[tuple[Any, Any, str]]:
    """Return the image of a result and, hidden, all that it rests on, each where it lies on the burst.

    Parameters
    ----------
    result : Reconstruction
        Of a run, or of a file.
    name : str
        In front of each layer's name.
    burst_look : dict
        How the burst would be shown: rgb, axis labels, and scale and units where they are known.
    """
    placement = _placement(result, burst_look)
    told = {"run": name, "quality": result.quality, "notes": result.notes}
    images: dict[str, Layer] = {
        kind: image_layer(data, axes, placement, result.canvas, number)
        for number, (kind, data, axes) in enumerate(placement.parts(result.image, result.acquisition))
    }
    evidence: dict[str, Layer] = {}
    for kind in kinds_of(result, placement):
        if kind not in _OF_FRAMES:
            evidence |= result_layers(kind, result, None, placement)
    # Images would hide outlines, path and arrows that lay below them.
    layers = images | dict(sorted(evidence.items(), key=lambda item: not isinstance(item[1], Image)))
    for kind, layer in layers.items():
        layer.name = f"{name}: {kind}"
        layer.metadata = {METADATA_KEY: {**told, "reconstruction": result} if kind in images else told}
        layer.visible = kind in images
    return [layer.as_layer_data_tuple() for layer in layers.values()]


def _placement(result: "Reconstruction", burst_look: dict[str, Any]) -> Placement:
    """Return where the burst lies when its file is opened; one that was cropped lies where it was cropped from."""
    taken = result.acquisition
    count, height, width, channels = taken.shape
    axes = "".join(burst_look["axis_labels"]).upper() + ("C" if burst_look["rgb"] else "")
    sizes = {"T": count, "Y": height, "X": width, "C": channels}
    pixels = np.broadcast_to(np.zeros((), taken.dtype), [sizes[axis] for axis in axes])
    burst = Image(pixels, contrast_limits=(taken.black_level, taken.white_level), **burst_look)
    return Placement.of([burst], axes, taken.origin)
