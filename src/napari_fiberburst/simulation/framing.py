"""Makes the frames of a simulated recording, each when it is read."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from hashlib import sha256
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from napari_fiberburst.simulation.camera import Camera
from napari_fiberburst.simulation.events import Bending, Cells
from napari_fiberburst.simulation.field import Optics
from napari_fiberburst.simulation.motion import apply
from napari_fiberburst.simulation.relay import Relay
from napari_fiberburst.simulation.simulate import OVERLAY_LIGHT

# How far a lifted probe's picture is blurred where no light comes back any more, pitches.
_BLUR = 4.0
# The filter that takes the cores out of a frame, in pitches, and the least light of the bundle that it divides by.
_FILTER, _LEAST_LIGHT = 0.5, 0.05


class World(Protocol):
    """What there is to see, such as a `Scene` or a `Slide`."""

    @property
    def channels(self) -> int:
        """Number of channels."""

    def sample(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return it (..., C) at frame-0 points (..., 2)."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """What frames look at."""

    world: World
    homographies: NDArray[np.float64]
    bending: Bending | None
    cells: Cells | None

    def look(self, number: int, pixels: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return what pixels (..., 2) of a frame look at, (..., C)."""
        points = apply(self.homographies[number], pixels)
        if self.bending is not None:
            points = points + self.bending.at(number, points)
        seen = self.world.sample(points)
        return seen if self.cells is None else seen + self.cells.light(number, points)[..., None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulator:
    """Makes frames of a recording when they are read."""

    views: Views
    relay: Relay
    optics: Optics
    physics: str
    camera: Camera
    exposures: NDArray[np.float64]
    lifts: NDArray[np.float32]
    channels: int
    seed: int

    def __call__(self, numbers: Sequence[int]) -> NDArray[np.generic]:
        """Return frames by their numbers, (n, H, W, C)."""
        frames = [self._frame(int(number)) for number in numbers]
        if not frames:
            return np.zeros((0, *self._shape, self.channels), np.uint8 if self.camera.bits == 8 else np.uint16)
        return np.stack(frames)

    def _frame(self, number: int) -> NDArray[np.generic]:
        seen = self._seen(number)
        flat = self.relay.flat.astype(np.float32)
        light = seen * flat if self.physics == "mask" else self.relay.through(seen)
        light = light * np.float32(self.exposures[number])
        if self.optics.shading is not None:
            light = light * self.optics.shading
        recorded = self.camera.record(light, np.random.default_rng((self.seed, number)))
        if self.physics == "filtered":
            recorded = self._without_cores(recorded)
        recorded[self.optics.marks] = round(OVERLAY_LIGHT * self.camera.full_scale)
        return recorded

    def _seen(self, number: int) -> NDArray[np.float32]:
        """Return what the bundle's end sees (H, W, C)."""
        lift = self.lifts[number]
        if lift == 1:
            return np.zeros((*self._shape, self.channels), np.float32)
        if lift > 0:
            sigma = float(_BLUR * self.relay.bundle.pitch * lift)
            blurred = gaussian_filter(self.views.look(number, pixels_of(self._shape)), (sigma, sigma, 0))
            return np.float32((1 - lift) ** 2) * blurred
        return self.views.look(number, pixels_of(self._shape))

    def _without_cores(self, recorded: NDArray[Any]) -> NDArray[Any]:
        """Return a frame (H, W, C) as vendors show it: smoothed, and divided by the bundle's light."""
        sigma = _FILTER * self.relay.bundle.pitch
        dark = self.camera.pedestal * self.camera.full_scale
        smooth = gaussian_filter(recorded.astype(np.float32) - np.float32(dark), (sigma, sigma, 0))
        shown = np.where(self._filtered_flat > _LEAST_LIGHT, smooth / np.maximum(self._filtered_flat, _LEAST_LIGHT), 0)
        shown = np.where(self.optics.field[..., None], shown, 0) + dark
        frame: NDArray[Any] = np.clip(np.rint(shown), 0, self.camera.full_scale).astype(recorded.dtype)
        return frame

    @property
    def _shape(self) -> tuple[int, int]:
        return self.relay.flat.shape[0], self.relay.flat.shape[1]

    @cached_property
    def _filtered_flat(self) -> NDArray[np.float32]:
        sigma = _FILTER * self.relay.bundle.pitch
        return gaussian_filter(self.relay.flat, (sigma, sigma, 0)).astype(np.float32)


def fingerprint_of(simulator: Simulator, some: NDArray[np.generic], rate: float) -> str:
    """Return what differs where any frame does: of all numbers that frames are made of, and of some frames."""
    views = simulator.views
    parts = [some, views.homographies, simulator.exposures, simulator.lifts, simulator.relay.flat]
    parts += [] if views.cells is None else [views.cells.places, views.cells.traces]
    parts += [] if views.bending is None else [views.bending.waves, views.bending.courses]
    digest = sha256(repr((simulator.camera, simulator.physics, simulator.seed, rate)).encode())
    for part in parts:
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


@lru_cache(maxsize=4)
def pixels_of(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the pixels of a frame, (H, W, 2) as (x, y)."""
    rows, columns = np.indices(shape, dtype=np.float64)
    pixels = np.stack([columns, rows], axis=-1)
    pixels.setflags(write=False)  # it is shared
    return pixels
