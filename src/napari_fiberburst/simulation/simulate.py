"""Simulated bursts with ground truth."""

from dataclasses import dataclass
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_fiberburst.data.burst import MIN_SIDE, Burst
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.simulation.bundle import Bundle, make_bundle
from napari_fiberburst.simulation.camera import Camera
from napari_fiberburst.simulation.motion import MOTIONS
from napari_fiberburst.simulation.scenes import Scene, make_scene

PHYSICS = ("mask", "core")
_BUNDLE_SETTINGS = [item.name for item in signature(make_bundle).parameters.values() if item.kind is item.KEYWORD_ONLY]


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedBurst:
    """A burst and the truth behind it.

    Attributes
    ----------
    burst : Burst
        What the camera recorded.
    truth : numpy.ndarray
        (T, H, W, C) float32 in [0, 1]: each frame without bundle and noise.
    homographies : numpy.ndarray
        (T, 3, 3) float64, frame-t pixel to frame-0 pixel, [0] the identity.
    transmission : numpy.ndarray
        (H, W) float64 in [0, 1]: what the camera sees of an even white scene.
    bundle : Bundle
        The cores.
    scene : Scene
        The object, also beyond frame 0's field.
    """

    burst: Burst
    truth: NDArray[np.float32]
    homographies: NDArray[np.float64]
    transmission: NDArray[np.float64]
    bundle: Bundle
    scene: Scene

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the burst as recorded and its truth as named arrays, as ``fiberburst simulate`` writes them."""
        span = self.burst.white_level - self.burst.black_level
        frames = np.rint(self.burst.frames * span + self.burst.black_level).astype(self.burst.dtype)
        return {
            "frames": frames,
            "axes": np.array("TYXC"),
            "white_level": np.array(self.burst.white_level),
            "truth": self.truth,
            "homographies": self.homographies,
            "transmission": self.transmission,
            "core_centres": self.bundle.centres,
        }


def simulate(
    scene: str | Scene = "histology",
    *,
    shape: tuple[int, int] = (256, 256),
    frames: int = 20,
    channels: int | None = None,
    motion: str | ArrayLike = "brownian",
    physics: str = "mask",
    camera: Camera | None = None,
    seed: int = 0,
    **bundle: Any,
) -> SimulatedBurst:
    """Simulate a burst of an object that moves behind a fibre bundle.

    Parameters
    ----------
    scene : str or Scene
        "histology", "retina", "cat", "usaf", "tissue", or a scene of your own.
    shape : (int, int)
        Height and width of a frame.
    frames : int
        T.
    channels : int, optional
        Default, the scene's own; 1 gives grey, others bands spread over its spectrum.
    motion : str or array_like
        "brownian", "handheld", "raster", or homographies (T, 3, 3), frame-t pixel to frame-0 pixel.
    physics : str
        "mask": frame = scene x transmission, as published. "core": each core averages the scene over its area, mixes
        with its neighbours and re-emits one value through its profile, as a real bundle does.
    camera : Camera, optional
        Default, 8 bits with one per cent of noise at full scale.
    seed : int
        The same seed gives the same burst.
    **bundle
        ``pitch``, ``jitter``, ``dead_cores`` and the like: see `make_bundle`.

    Returns
    -------
    SimulatedBurst

    Raises
    ------
    SettingsError
        An unknown scene, motion or physics, or a value out of range.
    """
    if physics not in PHYSICS:
        raise SettingsError(f"unknown physics {physics!r}; known: {', '.join(PHYSICS)}")
    _check_numbers(shape, frames, channels, seed)
    unknown = sorted(set(bundle) - set(_BUNDLE_SETTINGS))
    if unknown:
        raise SettingsError(f"unknown setting {unknown[0]!r}; known of the bundle: {', '.join(_BUNDLE_SETTINGS)}")
    camera = camera or Camera()
    # One generator for each part, so that a change of one leaves the others as they were.
    scene_rng, motion_rng, bundle_rng, camera_rng = np.random.default_rng(seed).spawn(4)
    world = scene if isinstance(scene, Scene) else make_scene(scene, shape, scene_rng)
    world = world.with_channels(world.channels if channels is None else channels)
    homographies = _motion(motion, frames, shape, motion_rng)
    cores = make_bundle(shape, bundle_rng, **bundle)
    rows, columns = np.indices(shape, dtype=np.float64)
    pixels = np.stack([columns, rows], axis=-1)
    truth = np.stack([world.sample(_apply(matrix, pixels)) for matrix in homographies])
    transmission = cores.transmission(shape)
    if physics == "mask":
        light = truth * transmission.astype(np.float32)[..., None]
    else:
        light = _through_cores(truth, cores)
    recorded = camera.record(light, camera_rng)
    grey = world.channels == 1
    pixels, axes = (recorded[..., 0], "TYX") if grey else (recorded, "TYXC")
    return SimulatedBurst(
        burst=Burst(pixels, axes=axes, black_level=0, white_level=camera.full_scale),
        truth=truth,
        homographies=homographies,
        transmission=transmission,
        bundle=cores,
        scene=world,
    )


def _apply(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map points by a homography; one shared with the solver would hide any error of convention."""
    x, y = points[..., 0], points[..., 1]
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
    mapped_x = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / depth
    mapped_y = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / depth
    return np.stack([mapped_x, mapped_y], axis=-1)


def _through_cores(truth: NDArray[np.float32], cores: Bundle) -> NDArray[np.float32]:
    """Return the light (T, H, W, C) that leaves the cores; each gathers what falls on its area."""
    _, height, width, channels = truth.shape
    profiles = cores.profiles((height, width)).astype(np.float32)
    area = np.maximum(profiles.sum(axis=0), np.finfo(np.float32).tiny)[:, None]
    light = np.empty_like(truth)
    for frame, shown in zip(truth, light, strict=True):
        gathered = (profiles.T @ frame.reshape(-1, channels)) / area
        emitted = cores.mix(gathered) * cores.gains[:, None].astype(np.float32)
        shown[:] = (profiles @ emitted).reshape(height, width, channels)
    return light


def _motion(
    motion: str | ArrayLike, frames: int, shape: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.float64]:
    if isinstance(motion, str):
        if motion not in MOTIONS:
            raise SettingsError(f"unknown motion {motion!r}; known: {', '.join(MOTIONS)}, or homographies (T, 3, 3)")
        return MOTIONS[motion](frames, shape, rng)
    homographies = np.array(motion, dtype=np.float64)
    if homographies.shape != (frames, 3, 3):
        raise SettingsError(f"homographies must have shape {(frames, 3, 3)}; got {homographies.shape}")
    if not np.allclose(homographies[0], np.eye(3)) or not (np.abs(np.linalg.det(homographies)) > 1e-12).all():
        raise SettingsError("homographies must begin with the identity, and each must have an inverse")
    return homographies


def _check_numbers(shape: tuple[int, int], frames: int, channels: int | None, seed: int) -> None:
    wanted = {"frames": (frames, 1), "channels": (1 if channels is None else channels, 1), "seed": (seed, 0)}
    if len(shape) != 2:
        raise SettingsError(f"shape must be (height, width); got {shape}")
    for name, (value, least) in {**wanted, "height": (shape[0], MIN_SIDE), "width": (shape[1], MIN_SIDE)}.items():
        if not isinstance(value, int | np.integer) or value < least:
            raise SettingsError(f"{name} must be an integer of at least {least}; got {value!r}")
