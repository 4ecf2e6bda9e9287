"""A bundle camera simulated in Python: pymmcore-plus takes it for a camera, without Micro-Manager or a microscope.

The extra `camera` brings what it needs.
"""

import time
from collections.abc import Mapping
from functools import cache
from tempfile import gettempdir
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.live.micromanager import Keyword, SimpleCameraDevice, UniMMCore
from napari_fiberburst.simulation import Camera, simulate_recording

LABEL = "Simulated bundle camera"
_SHAPE, _PITCH, _FRAMES = (256, 256), 5.0, 240
_MILLISECONDS = 1000 / 30
# A hand that goes to and fro over the object and comes back to where it was after the last frame: pixels, and how many
# times in all frames, along x and along y.
_SWINGS_X, _SWINGS_Y = ((34.0, 2), (9.0, 5), (2.0, 13)), ((26.0, 3), (11.0, 4), (2.0, 11))


class SimulatedBundleCamera(SimpleCameraDevice):
    """Shows the resolution chart through a bundle that is held by hand.

    Parameters
    ----------
    scene : str
        As in `napari_fiberburst.simulation.simulate_recording`.
    seed : int
        Of bundle, path and noise.
    """

    def __init__(self, scene: str = "usaf", seed: int = 0) -> None:
        super().__init__()
        self._exposure = _MILLISECONDS
        self._due = 0.0
        self._number = 0
        self._frames = _Clip(scene, seed)

    def sensor_shape(self) -> tuple[int, int]:
        """Return height and width."""
        return _SHAPE

    def dtype(self) -> type[np.uint8]:
        """Return the type of its pixels."""
        return np.uint8

    def get_exposure(self) -> float:
        """Return how long a frame takes, milliseconds."""
        return self._exposure

    def set_exposure(self, exposure: float) -> None:
        """Set how long a frame takes, milliseconds; the light stays as it is."""
        self._exposure = exposure

    def snap(self, buffer: NDArray[Any]) -> Mapping[str, Any]:
        """Wait as long as a frame takes, and fill the buffer with the next one."""
        self._due = max(self._due + self._exposure / 1000, time.perf_counter())
        buffer[:] = self._frames.at(self._number)
        self._number += 1
        time.sleep(max(0.0, self._due - time.perf_counter()))
        return {Keyword.Metadata_ImageNumber: str(self._number)}


class _Clip:
    """Frames that are made when they are first shown, again and again without a jump."""

    def __init__(self, scene: str, seed: int) -> None:
        # As many electrons as few microscopes get: noise is seen, and what averages it away.
        camera = Camera(photons=2000.0, read_noise=0.005)
        self._recording = simulate_recording(
            scene,
            shape=_SHAPE,
            pitch=_PITCH,
            path=_path(),
            camera=camera,
            seed=seed,
        )
        self._made = cache(self._make)

    def at(self, number: int) -> NDArray[np.uint8]:
        """Return a frame (H, W)."""
        return self._made(number % _FRAMES)

    def _make(self, number: int) -> NDArray[np.uint8]:
        return np.asarray(self._recording.source.recorded([number])[0, ..., 0], np.uint8)


def _path() -> NDArray[np.float64]:
    """Return homographies (T, 3, 3), frame-t pixel to frame-0 pixel."""
    turns = 2 * np.pi * np.arange(_FRAMES) / _FRAMES
    path = np.tile(np.eye(3), (_FRAMES, 1, 1))
    for axis, swings in enumerate((_SWINGS_X, _SWINGS_Y)):
        path[:, axis, 2] = sum(size * np.sin(times * turns) for size, times in swings)
    return path


def simulated_core() -> UniMMCore:
    """Return a core of pymmcore-plus whose camera is simulated."""
    # Any folder: without one, the core looks for Micro-Manager and complains that there is none.
    core = UniMMCore(mm_path=gettempdir())
    core.loadPyDevice(LABEL, SimulatedBundleCamera())
    core.initializeDevice(LABEL)
    core.setCameraDevice(LABEL)
    return core
