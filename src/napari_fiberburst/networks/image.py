"""The fitted field as a compressed representation of the burst: drawn at any size, saved, loaded, continued."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.coordinates import in_pixels, relative_to, unit_from_pixel
from napari_fiberburst.data.burst import Acquisition, check_frame
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.device import find_device
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.results import read_representation
from napari_fiberburst.networks.field import JointField
from napari_fiberburst.quality.resolution import RingCorrelation
from napari_fiberburst.results.reconstruction import Reconstruction, draw
from napari_fiberburst.scene.image import SplineImage
from napari_fiberburst.settings import NetworkMethod, Settings, SplineMethod, TrainedMethod

# Points drawn at a time: the widest layer's activations of this many take some 50 MB.
_CHUNK = 16_384
_DRAWN = "samples_drawn"
_BEHIND = "behind."
# Names in files of 0.1.0.
_FORMER_NAMES = {"sample_error": "held_out_rmse", "frame0_from_image": "reference_from_image"}


class Representation:
    """A fitted joint field with what is needed to draw it and to go on fitting it.

    Parameters
    ----------
    field : JointField
        On the device where it is drawn.
    frame_shape : (int, int)
        Height and width of the burst's frames.
    optimizer_state : dict or None
        Adam's moments, to continue exactly; None starts them afresh.
    drawn : int
        Samples drawn so far.
    behind : SplineImage, optional
        The first image of a calibrated burst: it knows what no core has looked at, how frames lie, and what
        intensity stands for no light.
    """

    def __init__(
        self,
        field: JointField,
        frame_shape: tuple[int, int],
        optimizer_state: dict[str, Any] | None = None,
        drawn: int = 0,
        behind: SplineImage | None = None,
    ) -> None:
        self.behind = behind
        self.field = field
        self.frame_shape = frame_shape
        self.optimizer_state = optimizer_state
        self.drawn = drawn
        self._unit_from_pixel = unit_from_pixel(frame_shape)

    def render(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float32]:
        """Return the scene as `frame` sees it, (H, W, C) in [0, 1], at that frame's pixels `points` (H, W, 2)."""

        def intensities(unit: Tensor, frames: Tensor) -> Tensor:
            shown: Tensor = self.field(unit, frames)
            return (shown + 1) / 2

        image = self._by_chunks(intensities, points, frame)
        return image if self.behind is None else self.behind.masked(image + self.behind.black, points, frame)

    def displacement(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float64]:
        """Return the displacement of each of a frame's pixels `points` to its frame-0 pixel, (H, W, 2) in pixels."""
        if frame == 0 and self.behind is None:
            return np.zeros_like(points)

        def moves(unit: Tensor, frames: Tensor) -> Tensor:
            return self.field.motion.frame0_points(unit, frames) - unit

        return self._by_chunks(moves, points, frame) / np.diag(self._unit_from_pixel)[:2]

    def homographies(self) -> NDArray[np.float64]:
        """Return (T, 3, 3), frame-t pixel to the reference frame's pixel; NaN for frames that were left out."""
        with torch.no_grad():
            scene_from_frame = self.field.motion.scene_from_frame().cpu().numpy().astype(np.float64)
        reference = 0 if self.behind is None else self.behind.reference
        relative = relative_to(in_pixels(scene_from_frame, self.frame_shape), reference)
        if self.behind is not None:
            relative[~self.behind.used] = np.nan
        return relative

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the fitted parameters, the random frequencies and the samples drawn, by name."""
        parameters = {name: value.cpu().numpy() for name, value in self.field.state_dict().items()}
        behind = {} if self.behind is None else self.behind.arrays()
        return {**parameters, _DRAWN: np.array(self.drawn), **{_BEHIND + name: part for name, part in behind.items()}}

    def _by_chunks(
        self, function: Callable[[Tensor, Tensor], Tensor], points: NDArray[np.float64], frame: int
    ) -> NDArray[np.float32]:
        device = self.field.motion.times.device
        unit = points.reshape(-1, 2) * np.diag(self._unit_from_pixel)[:2] + self._unit_from_pixel[:2, 2]
        parts = []
        with torch.no_grad():
            for start in range(0, len(unit), _CHUNK):
                chunk = torch.from_numpy(unit[start : start + _CHUNK].astype(np.float32)).to(device)
                frames = torch.full((len(chunk),), frame, device=device)
                parts.append(function(chunk, frames).cpu())
        values: NDArray[np.float32] = torch.cat(parts).numpy().reshape(*points.shape[:2], -1)
        return values


def load(path: str | Path, device: str = "auto") -> Reconstruction:
    """Read a reconstruction that was saved as ``.npz``, to draw it at any size or to continue it.

    Parameters
    ----------
    path : str or Path
        The file.
    device : str
        Where to draw it.

    Returns
    -------
    Reconstruction
        With the image drawn anew.

    Raises
    ------
    OutputError
        The file is not there, is no saved reconstruction, or is one whose image is NaN or infinity.
    DeviceError
        The device is not on this machine.
    """
    place = find_device(device)
    arrays, provenance = read_representation(path)
    try:
        return _rebuild(arrays, _with_names_of_today(provenance), place)
    except Exception as error:  # contents that do not belong together fail anywhere, in numpy, scipy or torch
        raise OutputError(
            f"{path} is no reconstruction that this version can read ({error!r}); make it again, or take another file"
        ) from error


def _with_names_of_today(plain: Any) -> Any:
    """Return what a file says with the names that its version had before replaced."""
    if not isinstance(plain, dict):
        return plain
    return {_FORMER_NAMES.get(name, name): _with_names_of_today(value) for name, value in plain.items()}


def _rebuild(arrays: dict[str, NDArray[Any]], provenance: dict[str, Any], device: torch.device) -> Reconstruction:
    settings = Settings.from_dict(provenance["settings"])
    acquisition = Acquisition.from_dict(provenance["burst"])
    canvas = _canvas(provenance["canvas"], acquisition)
    reference = int(provenance.get("reference", 0))
    renderer: SplineImage | Representation
    if isinstance(settings.method, SplineMethod):
        renderer = SplineImage.from_arrays(arrays, device)
        homographies = renderer.homographies
    else:
        renderer = _rebuild_networks(arrays, settings.method, acquisition, device)
        homographies = renderer.homographies()
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


def _rebuild_networks(
    arrays: dict[str, NDArray[Any]], method: TrainedMethod, acquisition: Acquisition, device: torch.device
) -> Representation:
    count, height, width, channels = acquisition.shape
    drawn = int(arrays.pop(_DRAWN))
    kept = {name.removeprefix(_BEHIND): arrays.pop(name) for name in list(arrays) if name.startswith(_BEHIND)}
    start = torch.eye(3).repeat(count, 1, 1) if isinstance(method, NetworkMethod) else None
    field = JointField(method, (count, height, width, channels), start=start)
    field.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
    behind = SplineImage.from_arrays(kept, device) if kept else None
    return Representation(field.to(device), (height, width), drawn=drawn, behind=behind)
