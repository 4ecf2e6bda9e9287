"""The solved spline as something to draw: the `Renderer` of a self-calibrated reconstruction."""

from functools import cached_property
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates, spline_filter
from torch import Tensor

from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.operators.grid import Grid

# What the spline takes the scene for beyond its nodes; nothing is drawn there.
_BEYOND: Final = "mirror"


class SplineImage:
    """A scene on a grid, and how frames look at it.

    Parameters
    ----------
    scene : Tensor
        (C, H, W), light of 0 to 1 above black.
    grid : Grid
        Its nodes, in the reference frame's pixels.
    known : Tensor
        (H, W) bool, nodes next to which a core has looked.
    reach : float
        Pixels; what is farther than this from all that is known is NaN.
    fill : bool
        Draw it all the same.
    homographies : numpy.ndarray
        (T, 3, 3), frame-t pixel to the reference frame's.
    black : float
        Intensity of no light.
    motion : FrameMotion, optional
        Where frames bend: into the scene that they were registered to.
    """

    def __init__(
        self,
        *,
        scene: Tensor,
        grid: Grid,
        known: Tensor,
        reach: float,
        fill: bool,
        homographies: NDArray[np.float64],
        black: float,
        motion: FrameMotion | None = None,
    ) -> None:
        self.scene, self.grid = scene, grid
        self._known, self._reach, self._fill = known, reach, fill
        self.homographies, self.black, self._motion = homographies, black, motion
        self._far: Tensor | None = None

    @property
    def parameters(self) -> int:
        """Numbers that were fitted: the nodes near samples, and eight to each frame that takes part."""
        nodes = int((self._distance() <= self._reach).sum()) * len(self.scene)
        return nodes + 8 * int(self.used.sum())

    def render(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float32]:
        """Return the scene as `frame` sees it, (H, W, C) in [0, 1], at that frame's pixels `points` (H, W, 2)."""
        mapped = np.nan_to_num(self._mapped(points, frame))
        x, y = (mapped[..., axis] - first for axis, first in enumerate((self.grid.x0, self.grid.y0)))
        at = np.stack([y, x]) / self.grid.spacing
        bands = [map_coordinates(band, at, np.float32, 3, _BEYOND, prefilter=False) for band in self._coefficients]
        return self.masked(np.stack(bands, axis=-1) + np.float32(self.black), points, frame)

    def masked(self, image: NDArray[np.float32], points: NDArray[np.float64], frame: int) -> NDArray[np.float32]:
        """Return an image (H, W, C) drawn at a frame's pixels, NaN off the scene, and where no core looked near."""
        places = torch.from_numpy(self._mapped(points, frame).astype(np.float32)).to(self.scene.device)
        sampling = self.grid.at(places)
        far = ~sampling.inside
        if not self._fill:
            far |= sampling(self._distance()) > self._reach
        return np.where(far.cpu().numpy()[..., None], np.float32(np.nan), image)

    @cached_property
    def _coefficients(self) -> list[NDArray[np.float32]]:
        """Each channel as a cubic spline, which does not dull the image between its nodes as a linear one would."""
        return [spline_filter(band, 3, np.float32, _BEYOND) for band in self.scene.cpu().numpy()]

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which frames take part, (T,)."""
        return np.isfinite(self.homographies[:, 0, 0])

    @property
    def reference(self) -> int:
        """The first frame that takes part: the image is in its pixels."""
        return int(np.flatnonzero(self.used)[0])

    def displacement(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float64]:
        """Return the displacement of each of a frame's pixels `points` to its reference pixel, (H, W, 2) in pixels."""
        return self._mapped(points, frame) - points

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that drawing needs, by name."""
        return {
            "scene": self.scene.cpu().numpy(),
            "known": self._known.cpu().numpy(),
            "nodes": np.array([self.grid.x0, self.grid.y0, self.grid.spacing]),
            "drawing": np.array([self._reach, float(self._fill), self.black]),
            "homographies": self.homographies,
            **({} if self._motion is None else self._motion.arrays()),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]], device: torch.device) -> "SplineImage":
        """Rebuild an image from `arrays`.

        Raises
        ------
        ValueError
            They do not belong together.
        """
        x0, y0, spacing = arrays["nodes"].tolist()
        reach, fill, black = arrays["drawing"].tolist()
        rows, columns = arrays["known"].shape
        count = len(arrays["homographies"])
        for name, dtype, shape in (
            ("scene", "float32", (len(arrays["scene"]), rows, columns)),
            ("known", "bool", (rows, columns)),
            ("homographies", "float64", (count, 3, 3)),
        ):
            if arrays[name].dtype != dtype or arrays[name].shape != shape:
                raise ValueError(f"{name} is {arrays[name].dtype} of {arrays[name].shape}, expected {dtype} of {shape}")
        if not (0 < spacing < np.inf and np.isfinite(arrays["nodes"]).all()):
            raise ValueError(f"nodes {spacing} px apart from ({x0}, {y0}) on are no scene")
        used = np.isfinite(arrays["homographies"]).all(axis=(1, 2))
        if not used.any():
            raise ValueError("no frame takes part")
        for name in {"scene_from_frame", "control"} & set(arrays):
            if not np.isfinite(arrays[name][used]).all():
                raise ValueError(f"{name} of frames that take part is not finite")
        return cls(
            scene=torch.from_numpy(arrays["scene"]).to(device),
            grid=Grid(x0, y0, spacing, (rows, columns)),
            known=torch.from_numpy(arrays["known"]).to(device),
            reach=reach,
            fill=bool(fill),
            homographies=arrays["homographies"],
            black=black,
            motion=FrameMotion.from_arrays(arrays),
        )

    def _mapped(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float64]:
        if self._motion is None:
            return transform_points(self.homographies[frame], points)
        if frame == self.reference:
            return points
        places = self._motion.of_frame(frame).apply(torch.from_numpy(points.reshape(-1, 2)))[0]
        mapped: NDArray[np.float64] = self._motion.to_reference(places, self.reference).numpy().reshape(points.shape)
        return mapped

    def _distance(self) -> Tensor:
        """Return how far each node is from what is known, pixels (H, W)."""
        if self._far is None:
            distance = distance_transform_edt(~self._known.cpu().numpy()) * self.grid.spacing
            self._far = torch.from_numpy(distance.astype(np.float32)).to(self.scene.device)
        return self._far
