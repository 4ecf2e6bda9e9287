"""The fitted field as a compressed representation of the burst: drawn at any size, kept, continued."""

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.coordinates import in_pixels, relative_to, unit_from_pixel
from napari_fiberburst.device import is_out_of_memory
from napari_fiberburst.networks.field import JointField
from napari_fiberburst.scene.image import SplineImage
from napari_fiberburst.settings import NetworkMethod, TrainedMethod

logger = logging.getLogger(__name__)

# Points drawn at a time: the widest layer's activations of this many take some 50 MB.
_CHUNK = 16_384
_DRAWN = "samples_drawn"
_BEHIND = "behind."


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
        self._chunk = _CHUNK
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

    @classmethod
    def from_arrays(
        cls,
        arrays: dict[str, NDArray[Any]],
        method: TrainedMethod,
        shape: tuple[int, int, int, int],
        device: torch.device,
    ) -> "Representation":
        """Rebuild a representation of a burst (frames, height, width, channels) from `arrays`.

        Raises
        ------
        ValueError
            The arrays are not those of the method's networks. No memory is taken for networks of another size.
        """
        kept = {name.removeprefix(_BEHIND): part for name, part in arrays.items() if name.startswith(_BEHIND)}
        own = {
            name: torch.from_numpy(part)
            for name, part in arrays.items()
            if name != _DRAWN and not name.startswith(_BEHIND)
        }

        def untrained() -> JointField:
            start = torch.eye(3).repeat(shape[0], 1, 1) if isinstance(method, NetworkMethod) else None
            return JointField(method, shape, start=start)

        with torch.device("meta"):
            sizes = {name: part.shape for name, part in untrained().state_dict().items()}
        if sizes != {name: part.shape for name, part in own.items()}:
            raise ValueError("its arrays are not those of the networks that it tells of")
        field = untrained()
        field.load_state_dict(own)
        behind = SplineImage.from_arrays(kept, device) if kept else None
        return cls(field.to(device), shape[1:3], drawn=int(arrays[_DRAWN].item()), behind=behind)

    def _by_chunks(
        self, function: Callable[[Tensor, Tensor], Tensor], points: NDArray[np.float64], frame: int
    ) -> NDArray[np.float32]:
        device = self.field.motion.times.device
        unit = points.reshape(-1, 2) * np.diag(self._unit_from_pixel)[:2] + self._unit_from_pixel[:2, 2]
        parts: list[Tensor] = []
        start = 0
        while start < len(unit):
            chunk = torch.from_numpy(unit[start : start + self._chunk].astype(np.float32)).to(device)
            try:
                with torch.no_grad():
                    parts.append(function(chunk, torch.full((len(chunk),), frame, device=device)).cpu())
                start += len(chunk)
                continue
            except (MemoryError, RuntimeError) as error:
                if not is_out_of_memory(error) or len(chunk) < 2:
                    raise
            self._chunk = len(chunk) // 2
            logger.warning("memory ran out; %d points are drawn at a time from now on", self._chunk)
        values: NDArray[np.float32] = torch.cat(parts).numpy().reshape(*points.shape[:2], -1)
        return values
