"""Probes whose bundle can be moved, turned, zoomed or exchanged, by the simulator's own physics."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from napari_fiberburst import Bundle, Burst
from napari_fiberburst.simulation import Camera, Scene, SimulatedBurst, simulate
from napari_fiberburst.simulation.bundle import Bundle as SimulatedBundle
from napari_fiberburst.simulation.bundle import make_bundle

# Pixels beyond each side of the frames in which the simulated bundle goes on, so that it can move.
MARGIN = 14


@dataclass(frozen=True, kw_only=True, eq=False)
class Probe:
    """A burst through a bundle that has moved since it was calibrated.

    Attributes
    ----------
    burst : Burst
        What the camera recorded.
    truth : numpy.ndarray
        (T, H, W, C), its frames without bundle and noise.
    flat : numpy.ndarray
        (H, W) uint8, the bundle in even light, before it moved.
    bundle : Bundle
        Calibrated from that.
    """

    burst: Burst
    truth: NDArray[np.float32]
    flat: NDArray[np.uint8]
    bundle: Bundle


def rigid(shape: tuple[int, int], shift: tuple[float, float], degrees: float, zoom: float) -> NDArray[np.float64]:
    """Return a rotation and zoom about the middle of the frame, then a shift, (2, 3)."""
    angle = np.radians(degrees)
    linear = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = (np.array(shape[::-1]) - 1) / 2
    return np.column_stack([linear, middle - linear @ middle + shift])


def through(truth: NDArray[np.float32], bundle: SimulatedBundle) -> NDArray[np.float32]:
    """Return what leaves a bundle (T, H, W, C): each core gathers the mean of the light on its area."""
    _, height, width, channels = truth.shape
    profiles = bundle.profiles((height, width))
    area = np.maximum(profiles.sum(axis=0), 1e-6)[:, None]
    light = [
        profiles @ (bundle.mix((profiles.T @ frame.reshape(-1, channels)) / area) * bundle.gains[:, None])
        for frame in truth
    ]
    return np.stack(light).reshape(truth.shape).astype(np.float32)


def cut(frames: NDArray) -> NDArray:
    return np.ascontiguousarray(frames[..., MARGIN:-MARGIN, MARGIN:-MARGIN, :])


@pytest.fixture(scope="session")
def probe() -> Callable[..., Probe]:
    """Return a function that simulates a probe."""

    def simulated(
        scene: str | Scene = "histology",
        *,
        shape: tuple[int, int] = (131, 153),
        shift: tuple[float, float] = (0.0, 0.0),
        degrees: float = 0.0,
        zoom: float = 1.0,
        another: int | None = None,
        brightness: float = 1.0,
        camera: Camera | None = None,
        **more: object,
    ) -> Probe:
        camera = camera or Camera()
        full = (shape[0] + 2 * MARGIN, shape[1] + 2 * MARGIN)
        settings = {"frames": 1, "pitch": 6.0, "channels": 1, "seed": 0, **more}
        seen: SimulatedBurst = simulate(scene, shape=full, physics="core", **settings)
        there = seen.bundle
        if another is not None:
            known = {name: settings[name] for name in ("pitch", "jitter", "outline") if name in settings}
            there = make_bundle(full, np.random.default_rng(another), **known)
        matrix = rigid(full, shift, degrees, zoom)
        centres = there.centres @ matrix[:, :2].T + matrix[:, 2]
        moved = replace(there, centres=centres, radii=there.radii * zoom, pitch=there.pitch * zoom)
        recorded = camera.record(cut(through(seen.truth * brightness, moved)), np.random.default_rng(5))
        flat = np.rint(cut(seen.transmission[..., None])[..., 0] * 200).astype(np.uint8)
        return Probe(
            burst=Burst(recorded, axes="TYXC", black_level=0, white_level=camera.full_scale),
            truth=cut(seen.truth),
            flat=flat,
            bundle=Bundle.from_image(flat, device="cpu"),
        )

    return simulated
