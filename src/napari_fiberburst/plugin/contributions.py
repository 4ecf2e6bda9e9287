"""What `napari.yaml` names: sample data, readers, a writer, and commands of the Layers menu.

Imported when napari starts to use one of them; loads neither torch nor, before it is needed, napari.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import tifffile

from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.archive import ARCHIVE_ENDINGS
from napari_fiberburst.io.bounds import open_arrays
from napari_fiberburst.io.results import is_model, write_whole
from napari_fiberburst.io.video_container import VIDEO_ENDINGS
from napari_fiberburst.plugin import METADATA_KEY, RECORDING_KEY

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle
    from napari_fiberburst.data.burst import Acquisition, Burst

LayerData = tuple[Any, dict[str, Any], str]
PLUGIN = "napari-fiberburst"
# As many frames and pixels as a sample can have that opens at once.
_SAMPLE_SHAPE, _SAMPLE_FRAMES = (256, 256), 20
# A recording by hand, as they are: it turns, comes nearer and loses contact.
_RECORDING_FRAMES: Final = 2000
_RECORDING_SETTINGS: Final[dict[str, Any]] = {
    "path": "handheld",
    "turn": 3.0,
    "zoom": 0.02,
    "gaps": 2,
    "flicker": 0.02,
    "drift": 0.1,
}
# What a file of a simulated burst holds of the recording; all else is truth.
_RECORDING = {"frames", "axes", "black_level", "white_level"}
# RGBA of a bundle's cores by their state, as `Bundle.image` has them, and the quantile of light that is shown white.
_CORE_COLOURS = {"core": (0.5, 0.8, 0.4, 1.0), "saturated": (1.0, 0.3, 0.3, 1.0), "dead": (0.2, 0.4, 1.0, 1.0)}
_BRIGHTEST = 0.99


def make_sample(scene: str, physics: str, **faults: Any) -> list[LayerData]:
    """Return a simulated burst as an image layer, its truth in the layer's metadata.

    Parameters
    ----------
    scene, physics : str
        As in `napari_fiberburst.simulation.simulate`.
    **faults
        As in `napari_fiberburst.simulation.Faults`.
    """
    from napari_fiberburst.simulation import Faults, simulate

    simulated = simulate(
        scene, shape=_SAMPLE_SHAPE, frames=_SAMPLE_FRAMES, physics=physics, faults=Faults(**faults) if faults else None
    )
    arrays = simulated.arrays()
    frames, is_grey = arrays["frames"], simulated.scene.channels == 1
    look = {
        "name": f"{scene} ({', '.join([physics, *(name.replace('_', ' ') for name in faults)])})",
        "rgb": not is_grey,
        "axis_labels": ("t", "y", "x"),
        "metadata": {METADATA_KEY: {"recipe": {"scene": scene, "physics": physics, **faults}, **_truth_in(arrays)}},
    }
    return [(frames[..., 0] if is_grey else frames, look, "image")]


def recording_slide() -> list[LayerData]:
    """Return a long simulated recording as an image layer, each frame made when it is shown; truth as `make_sample`."""
    from napari_fiberburst.plugin.recordings import recording_layer
    from napari_fiberburst.simulation import simulate_recording

    recording = simulate_recording("slide", frames=_RECORDING_FRAMES, **_RECORDING_SETTINGS)
    frames, look, kind = recording_layer(recording.source, f"recording, {_RECORDING_FRAMES:,} frames")
    look["metadata"][METADATA_KEY] |= {
        "recipe": {"scene": "slide", "frames": _RECORDING_FRAMES, **_RECORDING_SETTINGS},
        **recording.arrays(),
    }
    return [(frames, look, kind)]


# napari calls a sample by a name of its own, without arguments.
histology_mask = partial(make_sample, "histology", "mask")
histology_core = partial(make_sample, "histology", "core")
retina_mask = partial(make_sample, "retina", "mask")
retina_core = partial(make_sample, "retina", "core")
usaf_mask = partial(make_sample, "usaf", "mask")
usaf_core = partial(make_sample, "usaf", "core")
tissue_mask = partial(make_sample, "tissue", "mask")
tissue_core = partial(make_sample, "tissue", "core")
cells_mask = partial(make_sample, "cells", "mask")
cells_core = partial(make_sample, "cells", "core")
cat_mask = partial(make_sample, "cat", "mask")
cat_core = partial(make_sample, "cat", "core")
tissue_bending = partial(make_sample, "tissue", "core", deformation=3.0)
histology_faint = partial(make_sample, "histology", "core", flicker=0.05, contrast=0.07)
retina_round = partial(make_sample, "retina", "core", field=0.95, overlay=True, vignette=2.0)


def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[LayerData]] | None:
    """Return a reader for a recording, a folder of frames, a simulated burst, a bundle or a model, None for all else.

    Several videos, which napari gives where they are to be one stack, are one recording.
    """
    if not isinstance(path, str):
        return read if path and all(Path(one).suffix.lower() in VIDEO_ENDINGS for one in path) else None
    place = Path(path)
    if place.suffix.lower() == ".bundle":
        return read_bundle
    if is_model(place):
        return read_model
    is_burst = place.suffix.lower() in (*ARCHIVE_ENDINGS, *VIDEO_ENDINGS) or (place.is_dir() and _holds_frames(place))
    return read if is_burst else None


def read_bundle(path: str | Sequence[str]) -> list[LayerData]:
    """Open a bundle as the layers of `bundle_layers`.

    Raises
    ------
    BundleError
        The file is no bundle, or is damaged.
    """
    from napari_fiberburst.bundle.bundle import Bundle

    return bundle_layers(Bundle.load(str(path)), Path(str(path)).stem, path=str(path))


def read_model(path: str | Sequence[str]) -> list[LayerData]:
    """Open a model as the layers of its run: its image and, hidden, what that rests on.

    An image that is not good is told to be so.

    Raises
    ------
    OutputError
        The file is no model, or is damaged.
    """
    from napari.utils.notifications import show_warning

    from napari_fiberburst.networks.saved import load
    from napari_fiberburst.plugin.models import model_layers

    place = Path(str(path))
    result = load(place)
    if result.quality not in (None, "good"):
        show_warning(f"{place.name}: the image is {result.quality}: {'; '.join(result.notes)}")
    return model_layers(result, place.stem, _look(result.acquisition))


def bundle_layers(bundle: "Bundle", name: str, *, path: str | None = None) -> list[LayerData]:
    """Return a bundle as its transmission, with the bundle itself in the metadata, and its cores as points.

    Points are as large as a core's footprint. Saturated cores are red, dead ones blue.

    Parameters
    ----------
    bundle : Bundle
        What to show.
    name : str
        Of the layer.
    path : str, optional
        The file that holds it.
    """
    bright = float(np.quantile(bundle.transmission[bundle.outline], _BRIGHTEST)) if bundle.outline.any() else 1.0
    look = {
        "name": name,
        "axis_labels": ("y", "x"),
        "contrast_limits": (0.0, max(bright, 1e-6)),
        "metadata": {METADATA_KEY: {"bundle": bundle, "path": path}},
    }
    layers: list[LayerData] = [(bundle.transmission, look, "image")]
    if bundle.is_resolved:
        states = np.append(np.where(bundle.saturated, "saturated", "core"), ["dead"] * len(bundle.dead))
        cores = {
            "name": f"{name} cores",
            "axis_labels": ("y", "x"),
            "size": 2 * bundle.radius,
            "features": {"state": states},
            "face_color": "transparent",
            "border_color": np.array([_CORE_COLOURS[state] for state in states]),
        }
        layers.append((np.concatenate([bundle.centres, bundle.dead])[:, ::-1], cores, "points"))
    return layers


def read(path: str | Sequence[str]) -> list[LayerData]:
    """Open a burst as an image layer, with pixel size, unit and, where the file has it, the truth.

    Of a recording that is longer than a burst, frames are read when they are shown.

    Raises
    ------
    BurstError
        The file or folder is no usable burst.
    """
    from napari_fiberburst.io import open_recording, read_burst
    from napari_fiberburst.plugin.recordings import LONGEST_BURST, name_of, recording_layer

    if not isinstance(path, str) or Path(path).suffix.lower() not in ARCHIVE_ENDINGS:
        source = open_recording(path if isinstance(path, str) else [Path(one) for one in path])
        if len(source) > LONGEST_BURST or not isinstance(path, str):
            return [recording_layer(source, name_of(path), path)]
    burst = read_burst(str(path))
    frames = _as_recorded(burst)
    place = Path(str(path))
    look = {"name": place.stem, **_look(burst), "metadata": {METADATA_KEY: _truth(place)}}
    if frames.ndim == 4 and not look["rgb"]:
        frames = frames.transpose(0, 3, 1, 2)  # napari draws the last two axes
    recording = {"channel_names": burst.channel_names, "times": () if burst.times is None else burst.times.tolist()}
    look["metadata"][METADATA_KEY] |= {"burst_path": str(path), "shape": frames.shape, RECORDING_KEY: recording}
    return [(frames, look, "image")]


def write(path: str, data: Any, attributes: dict[str, Any]) -> list[str]:
    """Write the image of a run as OME-TIFF, with its settings and findings as JSON beside it, or all of it as a model.

    Other image layers become plain OME-TIFF: napari gives this writer every layer that is saved as ``.ome.tif``.

    Raises
    ------
    OutputError
        The file cannot be written, or a layer that is of no run was to be written as a model.
    """
    metadata = attributes.get("metadata", {}).get(METADATA_KEY, {})
    result = metadata.get("reconstruction")
    if result is not None:
        return [str(result.save(path))]
    if is_model(Path(path)):
        raise OutputError(f"a model holds the image of a run, and this layer is none; save it as .ome.tif, not {path}")
    with write_whole(Path(path)) as stream:
        tifffile.imwrite(
            stream, np.asarray(data), ome=True, photometric="rgb" if attributes.get("rgb") else "minisblack"
        )
    return [path]


def reconstruct_layer() -> None:
    """Open the dock and reconstruct the layer that is selected."""
    _start("image")


def register_layer() -> None:
    """Open the dock, register the frames of the layer that is selected, and show them moved into place."""
    _start("stabilised burst")


def _start(show: str) -> None:
    import napari
    from napari.utils.notifications import show_error

    from napari_fiberburst.plugin.commands import find_dock

    viewer = napari.current_viewer()
    if viewer is None:
        return
    layer = viewer.layers.selection.active
    dock = find_dock(viewer, may_open=True)
    if layer is None:
        show_error("no layer is selected; select the burst's layer")
    elif dock is not None:
        dock.start_on(layer, show)


def _holds_frames(folder: Path) -> bool:
    from napari_fiberburst.io.folder import IMAGE_ENDINGS

    return any(item.suffix.lower() in (*IMAGE_ENDINGS, *VIDEO_ENDINGS) for item in folder.iterdir())


def _as_recorded(burst: "Burst") -> np.ndarray:
    """Return the frames in the type that they had in the file."""
    values = burst.frames * (burst.white_level - burst.black_level) + burst.black_level
    frames = np.rint(values).astype(burst.dtype) if burst.dtype.kind in "ui" else values.astype(burst.dtype)
    return frames if "C" in burst.axes else frames[..., 0]


def _look(burst: "Acquisition") -> dict[str, Any]:
    """Return how a burst is to be shown: as colour or as channels, and with its pixel size."""
    is_colour = "C" in burst.axes and burst.shape[3] == 3 and burst.dtype == np.uint8
    axes = "tyx" if is_colour or "C" not in burst.axes else "tcyx"
    look: dict[str, Any] = {"rgb": is_colour, "axis_labels": tuple(axes)}
    if burst.pixel_size is not None:
        height, width = burst.pixel_size
        sizes = {"y": height, "x": width}
        look["scale"] = tuple(sizes.get(axis, 1.0) for axis in axes)
        look["units"] = tuple(burst.unit or "µm" if axis in sizes else "pixel" for axis in axes)
    return look


def _truth_in(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is known of a simulated burst beside its recording."""
    return {name: arrays[name] for name in arrays if name not in _RECORDING}


def _truth(path: Path) -> dict[str, Any]:
    """Return the truth that a simulated burst's file carries."""
    if path.suffix.lower() not in ARCHIVE_ENDINGS:
        return {}
    with open_arrays(path) as arrays:
        if not {"truth", "homographies"} <= set(arrays):
            return {}
        return _truth_in(arrays)
