"""Results that were saved, read back to be drawn at any size, looked into, or continued."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Acquisition, check_frame
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.device import find_device
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.results import SOFTWARE, is_model, read_representation
from napari_fiberburst.networks.image import Representation
from napari_fiberburst.quality.resolution import RingCorrelation
from napari_fiberburst.results.model import Model
from napari_fiberburst.results.reconstruction import Reconstruction, draw
from napari_fiberburst.scene.image import SplineImage
from napari_fiberburst.settings import Method, Settings, SplineMethod

# Names in files of 0.1.0.
_FORMER_NAMES = {"sample_error": "held_out_rmse", "frame0_from_image": "reference_from_image"}


def load(path: str | Path, device: str = "auto") -> Reconstruction:
    """Read a reconstruction that was saved, without its burst.

    Parameters
    ----------
    path : str or Path
        The file: ``.fiberburst``, a model, with all that the result had but its `solver`; or ``.npz``, with what
        the image is drawn from, but nothing of what it rests on.
    device : str
        Where to draw it.

    Returns
    -------
    Reconstruction
        It draws what the saved one drew, to float rounding. The image of a ``.npz`` file is drawn anew.

    Raises
    ------
    OutputError
        The file is not there, is no saved reconstruction, is damaged or was altered, is of another version, or, of
        ``.npz``, is one whose image is NaN or infinity.
    DeviceError
        The device is not on this machine.

    Notes
    -----
    Nothing in such a file can be executed, and memory is taken for what the file holds, not for what it claims.
    """
    place = find_device(device, needs_double=False)
    if is_model(Path(path)):
        model = Model.load(path)
        return _readable(path, lambda: _restored(model, place))
    arrays, provenance = read_representation(path)
    return _readable(path, lambda: _rebuild(arrays, _with_names_of_today(provenance), place))


def _readable(path: str | Path, build: Callable[[], Reconstruction]) -> Reconstruction:
    try:
        return build()
    except Exception as error:  # contents that do not belong together fail anywhere, in numpy, scipy or torch
        raise OutputError(
            f"{path} is no reconstruction that this version can read ({error!r}); make it again, or take another file"
        ) from error


def _with_names_of_today(plain: Any) -> Any:
    """Return what a file says with the names that its version had before replaced."""
    if not isinstance(plain, dict):
        return plain
    return {_FORMER_NAMES.get(name, name): _with_names_of_today(value) for name, value in plain.items()}


def _restored(model: Model, device: torch.device) -> Reconstruction:
    """Return the result that a model holds."""
    renderer = _renderer(model.drawn_from, Settings.from_dict(model.settings).method, model.taken, device)
    result = model.result(renderer)
    # A few pixels of each frame: contents that do not belong together fail now, and not when somebody draws them.
    field = Canvas.over((0, 0, *result.acquisition.shape[2:0:-1]), 2 / max(result.acquisition.shape[1:3]))
    for frame in range(result.acquisition.shape[0]):
        renderer.displacement(field.points(), frame)
        if np.isinf(draw(renderer, field, frame, result.acquisition)).any():
            raise ValueError("what it draws is infinite")
    return result


def _renderer(
    arrays: dict[str, NDArray[Any]], method: Method, acquisition: Acquisition, device: torch.device
) -> SplineImage | Representation:
    """Return what draws the scene of a burst that a method has fitted."""
    if not isinstance(method, SplineMethod):
        return Representation.from_arrays(arrays, method, acquisition.shape, device)
    image = SplineImage.from_arrays(arrays, device)
    frames, *_, channels = acquisition.shape
    if (len(image.homographies), len(image.scene)) != (frames, channels):
        raise ValueError(f"a scene of shape {tuple(image.scene.shape)} is not that of {frames} frames")
    return image


def _rebuild(arrays: dict[str, NDArray[Any]], provenance: dict[str, Any], device: torch.device) -> Reconstruction:
    settings = Settings.from_dict(provenance["settings"])
    acquisition = Acquisition.from_dict(provenance["burst"])
    canvas = _canvas(provenance["canvas"], acquisition)
    reference = int(provenance.get("reference", 0))
    renderer = _renderer(arrays, settings.method, acquisition, device)
    homographies = renderer.homographies if isinstance(renderer, SplineImage) else renderer.homographies()
    return Reconstruction(
        image=_drawn(renderer, canvas, reference, acquisition),
        canvas=canvas,
        homographies=homographies,
        losses=np.array([np.nan if loss is None else loss for loss in provenance["losses"]], dtype=np.float32),
        requested=Settings.from_dict(provenance.get("requested", provenance["settings"])),
        settings=settings,
        seconds=float(provenance["seconds"]),
        parameters=int(provenance["parameters"]),
        device=str(device),
        ending=provenance["ending"],
        acquisition=acquisition,
        renderer=renderer,
        made_with={"software": SOFTWARE, "versions": provenance.get("versions", {})},
        reference=reference,
        held_out_rmse=provenance.get("held_out_rmse"),
        frames_used=None if provenance.get("frames_used") is None else tuple(provenance["frames_used"]),
        confidence=_per_frame(provenance, "confidence"),
        quality=provenance.get("quality"),
        misfit=provenance.get("misfit"),
        exposures=_per_frame(provenance, "exposures"),
        resolution=provenance.get("resolution"),
        agreement=_agreement(provenance),
        notes=tuple(provenance.get("notes", ())),
    )


def _canvas(told: dict[str, Any], acquisition: Acquisition) -> Canvas:
    height, width = told["shape"]
    if not (isinstance(height, int) and isinstance(width, int) and height > 0 and width > 0):
        raise ValueError(f"an image of {height!r} x {width!r} pixels cannot be drawn")
    check_frame(height, width, acquisition.shape[3])
    return Canvas(shape=(height, width), reference_from_image=np.array(told["reference_from_image"]))


def _drawn(
    renderer: SplineImage | Representation, canvas: Canvas, frame: int, acquisition: Acquisition
) -> NDArray[np.float32]:
    """Draw the image; refuse one that shows nothing, which no run has made."""
    image = draw(renderer, canvas, frame, acquisition)
    if np.isinf(image).any() or np.isnan(image).all():
        raise ValueError("its image is NaN or infinity; the file is damaged, so make it again")
    return image


def _per_frame(provenance: dict[str, Any], name: str) -> NDArray[np.float64] | None:
    """Return one number a frame, NaN where the file has none; None where it does not know them."""
    values = provenance.get(name)
    return None if values is None else np.array(values, dtype=np.float64)


def _agreement(provenance: dict[str, Any]) -> RingCorrelation | None:
    told, resolution = provenance.get("agreement"), provenance.get("resolution")
    if told is None:
        return None
    frequency, correlation = (_per_frame(told, name) for name in ("frequency", "correlation"))
    assert frequency is not None
    assert correlation is not None
    return RingCorrelation(frequency, correlation, np.nan if resolution is None else resolution)
