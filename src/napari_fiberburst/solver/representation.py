"""The fitted field as a compressed representation of the burst: drawn at any size, saved, loaded, continued."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.burst import Acquisition
from napari_fiberburst.errors import FiberBurstError, OutputError
from napari_fiberburst.fields import JointField
from napari_fiberburst.geometry.coordinates import in_pixels, unit_from_pixel
from napari_fiberburst.geometry.homography import relative_to_first
from napari_fiberburst.io.results import read_representation
from napari_fiberburst.reconstruction import Canvas, Reconstruction, draw
from napari_fiberburst.settings import Settings
from napari_fiberburst.solver.device import find_device

# Points drawn at a time: the widest layer's activations of this many take some 50 MB.
_CHUNK = 16_384
_DRAWN = "samples_drawn"


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
    """

    def __init__(
        self,
        field: JointField,
        frame_shape: tuple[int, int],
        optimizer_state: dict[str, Any] | None = None,
        drawn: int = 0,
    ) -> None:
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

        return self._by_chunks(intensities, points, frame)

    def displacement(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float64]:
        """Return the way from each of a frame's pixels `points` to its frame-0 pixel, (H, W, 2) in pixels."""
        if frame == 0:
            return np.zeros_like(points)

        def moves(unit: Tensor, frames: Tensor) -> Tensor:
            return self.field.motion.frame0_points(unit, frames) - unit

        return self._by_chunks(moves, points, frame) / np.diag(self._unit_from_pixel)[:2]

    def homographies(self) -> NDArray[np.float64]:
        """Return (T, 3, 3), frame-t pixel to frame-0 pixel."""
        with torch.no_grad():
            scene_from_frame = self.field.motion.scene_from_frame().cpu().numpy().astype(np.float64)
        return relative_to_first(in_pixels(scene_from_frame, self.frame_shape))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the fitted parameters, the random frequencies and the samples drawn, by name."""
        parameters = {name: value.cpu().numpy() for name, value in self.field.state_dict().items()}
        return {**parameters, _DRAWN: np.array(self.drawn)}

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
        The file is not there or is no saved reconstruction.
    DeviceError
        The device is not on this machine.
    """
    place = find_device(device)
    arrays, provenance = read_representation(path)
    try:
        return _rebuild(arrays, provenance, place)
    except (FiberBurstError, KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise OutputError(f"{path} is no reconstruction that this version can read: {error!r}") from error


def _rebuild(arrays: dict[str, NDArray[Any]], provenance: dict[str, Any], device: torch.device) -> Reconstruction:
    settings = Settings.from_dict(provenance["settings"])
    acquisition = Acquisition.from_dict(provenance["burst"])
    count, height, width, channels = acquisition.shape
    drawn = int(arrays.pop(_DRAWN))
    field = JointField(settings, count, channels)
    field.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
    representation = Representation(field.to(device), (height, width), drawn=drawn)
    canvas = Canvas.over((0, 0, width, height))
    return Reconstruction(
        image=draw(representation, canvas, 0, acquisition),
        canvas=canvas,
        homographies=representation.homographies(),
        losses=np.array(provenance["losses"], dtype=np.float32),
        settings=settings,
        seconds=float(provenance["seconds"]),
        parameters=field.parameter_count,
        device=str(device),
        ending=provenance["ending"],
        acquisition=acquisition,
        renderer=representation,
    )
