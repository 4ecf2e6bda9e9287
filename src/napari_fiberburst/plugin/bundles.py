"""From napari's layers to a bundle: one that was opened from a file, or an image of it in even light."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from napari.layers import Image, Layer

from napari_fiberburst.plugin import METADATA_KEY
from napari_fiberburst.plugin.bursts import data_of, words_of

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle

# (H, W), (H, W, C), (T, H, W) and (T, H, W, C).
_MOST_AXES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class BundleSource:
    """A bundle as a layer holds it.

    Attributes
    ----------
    name : str
        The layer.
    image : array
        Its data: the transmission of a bundle that is known, or else an image of the bundle in even light.
    bundle : Bundle or None
        The bundle, where it is known.
    words : str
        How the array is called in napari's console.
    path : str or None
        The file that holds the bundle.
    """

    name: str
    image: Any
    bundle: "Bundle | None" = None
    words: str
    path: str | None = None

    @property
    def given(self) -> Any:
        """What `napari_fiberburst.reconstruct` takes as its bundle."""
        return self.image if self.bundle is None else self.bundle


def bundle_source(layer: Image) -> BundleSource:
    """Describe the bundle that a layer holds."""
    metadata = layer.metadata.get(METADATA_KEY, {})
    return BundleSource(
        name=layer.name,
        image=data_of(layer),
        bundle=metadata.get("bundle"),
        words=words_of(layer),
        path=metadata.get("path"),
    )


def may_be_burst(layer: Layer) -> bool:
    """Whether a layer is an image that this plugin has not made."""
    return isinstance(layer, Image) and not is_result(layer) and not _holds_bundle(layer)


def may_be_bundle(layer: Layer) -> bool:
    """Whether a layer holds a bundle that was opened, or could be an image of one in even light."""
    if _holds_bundle(layer):
        return True
    return may_be_burst(layer) and not layer.multiscale and layer.data.ndim <= _MOST_AXES


def is_result(layer: Layer) -> bool:
    """Whether a run has made a layer."""
    return "run" in layer.metadata.get(METADATA_KEY, {})


def _holds_bundle(layer: Layer) -> bool:
    return "bundle" in layer.metadata.get(METADATA_KEY, {})
