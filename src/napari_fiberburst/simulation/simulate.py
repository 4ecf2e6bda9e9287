"""Simulated bursts with ground truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_fiberburst.data.burst import MIN_SIDE, Burst
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.simulation.bundle import Bundle, make_bundle
from napari_fiberburst.simulation.camera import Camera
from napari_fiberburst.simulation.faults import Draws, Faults, draw, exposed_over
from napari_fiberburst.simulation.field import Optics, make_optics
from napari_fiberburst.simulation.motion import MOTIONS, apply
from napari_fiberburst.simulation.relay import (
    Fading,
    Relay,
    find_bundle,
    moved_flat,
    prepared_flat,
    relay_of_design,
    relay_of_flat,
)
from napari_fiberburst.simulation.scenes import Scene, make_scene

PHYSICS = ("mask", "core")
_BUNDLE_SETTINGS = [item.name for item in signature(make_bundle).parameters.values() if item.kind is item.KEYWORD_ONLY]
_SHAPE = (256, 256)
# How bright the intruder and burned-in marks are, in parts of full scale.
_INTRUDER_LIGHT, OVERLAY_LIGHT = 0.95, 0.94
# What relays light where the bundle has moved by an offset (x, y), pixels.
RelayAt = Callable[[NDArray[np.float64]], Relay]


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedBurst:
    """A burst and the truth behind it.

    Attributes
    ----------
    burst : Burst
        What the camera recorded.
    truth : numpy.ndarray
        (T, H, W, C) float32 in [0, 1]: the object as each frame's pixels look at it in the middle of the exposure, bent
        as it is then; without bundle, intruder, flicker, smear, shading and noise.
    homographies : numpy.ndarray
        (T, 3, 3) float64, frame-t pixel to frame-0 pixel, [0] the identity.
    transmission : numpy.ndarray
        (H, W) float64 in [0, 1]: what the camera sees of an even white scene in frame 0, the mean of the channels.
    flat : numpy.ndarray
        (H, W, C) float64: the same of each channel; (H, W, 1) where all are alike.
    bundle : Bundle
        The cores, where they are in frame 0.
    scene : Scene
        The object, also beyond frame 0's field.
    faults : Faults
        What is wrong with the recording.
    exposures : numpy.ndarray
        (T,) float64: what the light of each frame is multiplied by, geometric mean 1.
    usable : numpy.ndarray
        (T,) bool: neither black nor white.
    bundle_offsets : numpy.ndarray
        (T, 2) float64: how far the bundle has moved on the camera since frame 0, (x, y) in pixels.
    displacement : numpy.ndarray or None
        (T, H, W, 2) float32, (x, y) in pixels: the pixel x of frame t looks at the point
        ``homographies[t](x) + displacement[t](x)`` of frame 0.
    intruder : numpy.ndarray or None
        (T, H, W) bool: where something else hides the object.
    background : numpy.ndarray or None
        (H, W, C) float32: light of the bundle itself, background and offsets, in frame 0, at an exposure of 1, in parts
        of full scale.
    shading : numpy.ndarray or None
        (H, W, C) float32 in [0, 1]: what vignette and round field leave of the light.
    visible : numpy.ndarray or None
        (H, W) bool: inside the field and not under a burned-in mark; None where the whole frame is.
    """

    burst: Burst
    truth: NDArray[np.float32]
    homographies: NDArray[np.float64]
    transmission: NDArray[np.float64]
    flat: NDArray[np.float64]
    bundle: Bundle
    scene: Scene
    faults: Faults
    exposures: NDArray[np.float64]
    usable: NDArray[np.bool_]
    bundle_offsets: NDArray[np.float64]
    displacement: NDArray[np.float32] | None
    intruder: NDArray[np.bool_] | None
    background: NDArray[np.float32] | None
    shading: NDArray[np.float32] | None
    visible: NDArray[np.bool_] | None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the burst as recorded and its truth as named arrays, as ``fiberburst simulate`` writes them.

        What the burst does not have, such as a displacement without deformation, is left out.
        """
        found = {
            "frames": self._recorded(),
            "axes": np.array("TYXC"),
            "white_level": np.array(self.burst.white_level),
            "truth": self.truth,
            "homographies": self.homographies,
            "transmission": self.transmission,
            "core_centres": self.bundle.centres,
            "exposures": self.exposures,
            "usable": self.usable,
            "bundle_offsets": self.bundle_offsets,
        }
        optional = {
            name: getattr(self, name) for name in ("displacement", "intruder", "background", "shading", "visible")
        }
        optional["flat"] = self.flat if self.flat.shape[2] > 1 else None
        return found | {name: array for name, array in optional.items() if array is not None}

    def take(self, frames: Sequence[int] | NDArray[np.integer]) -> "SimulatedBurst":
        """Return some of the frames, in this order, with their truth.

        Raises
        ------
        SettingsError
            The first one is not frame 0, to which all others are related.
        """
        chosen = np.asarray(frames)
        if not len(chosen) or chosen[0] != 0:
            raise SettingsError(f"the frames taken must begin with frame 0; got {chosen.tolist()}")
        return replace(
            self,
            burst=_as_burst(self._recorded()[chosen], self.burst.white_level),
            truth=self.truth[chosen],
            homographies=self.homographies[chosen],
            exposures=self.exposures[chosen],
            usable=self.usable[chosen],
            bundle_offsets=self.bundle_offsets[chosen],
            displacement=None if self.displacement is None else self.displacement[chosen],
            intruder=None if self.intruder is None else self.intruder[chosen],
        )

    def _recorded(self) -> NDArray[Any]:
        """Return the frames (T, H, W, C) as the camera gave them."""
        span = self.burst.white_level - self.burst.black_level
        recorded: NDArray[Any] = np.rint(self.burst.frames * span + self.burst.black_level)
        return recorded.astype(self.burst.dtype)


def simulate(
    scene: str | Scene = "histology",
    *,
    shape: tuple[int, int] | None = None,
    frames: int = 20,
    channels: int | None = None,
    motion: str | ArrayLike = "brownian",
    physics: str = "mask",
    camera: Camera | None = None,
    faults: Faults | None = None,
    flat: ArrayLike | None = None,
    seed: int = 0,
    **bundle: Any,
) -> SimulatedBurst:
    """Simulate a burst of an object that moves behind a fibre bundle.

    Parameters
    ----------
    scene : str or Scene
        "histology", "retina", "cat", "usaf", "tissue", "cells", or a scene of your own.
    shape : (int, int), optional
        Height and width of a frame. Default 256 x 256, or all of `flat`; a smaller shape is its middle.
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
    faults : Faults, optional
        What is wrong with the recording: flicker, deformation, a vignette and others. Default, nothing.
    flat : array_like, optional
        (H, W), or (H, W, C) in the scene's channels: an image of a real bundle in even light, which becomes the bundle.
        Its cores are found in it, and of the bundle's settings it takes ``crosstalk`` alone, 0 by default.
    seed : int
        The same seed gives the same burst; a fault that is switched on leaves everything else as it was.
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
    size = shape or (_SHAPE if flat is None else np.shape(flat)[:2])
    check_numbers(size, frames, channels, seed)
    check_bundle(bundle, is_measured=flat is not None)
    camera, faults = camera or Camera(), faults or Faults()
    # One generator for each part, so that a change of one leaves the others as they were.
    scene_rng, motion_rng, bundle_rng, camera_rng, faults_rng = np.random.default_rng(seed).spawn(5)
    world = scene if isinstance(scene, Scene) else make_scene(scene, size, scene_rng)
    world = world.with_channels(world.channels if channels is None else channels)
    homographies = _motion(motion, frames, size, motion_rng)
    if flat is None:
        relay_at = designed(make_bundle(size, bundle_rng, **bundle), size, faults.contrast)
    else:
        relay_at = measured(prepared_flat(flat, size, world.channels), faults.contrast, **bundle)
    relay = relay_at(np.zeros(2))
    optics = make_optics(faults, size, world.channels, is_circle=bundle.get("outline") == "circle")
    draws = draw(faults, frames, optics.field, optics.radius, len(relay.bundle.centres), faults_rng)
    truth, seen = _look(world, size, homographies, draws, faults.smear)
    moved = relay_at(draws.bundle_offsets[-1]) if draws.bundle_offsets.any() else relay
    relays = [moved if offset.any() else relay for offset in draws.bundle_offsets]
    light, background = _relayed(seen, relays, physics, draws, optics, faults)
    flat_field = relay.flat if optics.shading is None else relay.flat * optics.shading
    return SimulatedBurst(
        burst=_as_burst(_photographed(light, camera, camera_rng, draws, optics), camera.full_scale),
        truth=truth,
        homographies=homographies,
        transmission=flat_field.mean(axis=2),
        flat=flat_field,
        bundle=relay.bundle,
        scene=world,
        faults=faults,
        exposures=draws.exposures,
        usable=draws.usable,
        bundle_offsets=draws.bundle_offsets,
        displacement=draws.displacement,
        intruder=None if draws.hidden is None else draws.hidden > 0.5,
        background=background,
        shading=optics.shading,
        visible=optics.visible,
    )


def _look(
    world: Scene, shape: tuple[int, int], homographies: NDArray[np.float64], draws: Draws, smear: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return what the frames' pixels look at (T, H, W, C): in the middle of each exposure, and all through it.

    The latter has the intruder in it.
    """
    rows, columns = np.indices(shape, dtype=np.float64)
    pixels = np.stack([columns, rows], axis=-1)

    def points(number: int) -> NDArray[np.float64]:
        rigid = apply(homographies[number], pixels)
        return rigid if draws.displacement is None else rigid + draws.displacement[number]

    truth = np.stack([world.sample(points(number)) for number in range(len(homographies))])
    seen = truth
    if smear > 0 and len(homographies) > 1:
        seen = np.empty_like(truth)
        for number in range(len(homographies)):
            before = min(number, len(homographies) - 2)  # the last frame goes on as the one before it
            poses = exposed_over(points(number), points(before + 1) - points(before), smear)
            seen[number] = np.mean([world.sample(pose) for pose in poses], axis=0)
    if draws.hidden is not None:
        hidden = draws.hidden[..., None]
        seen = seen * (1 - hidden) + np.float32(_INTRUDER_LIGHT) * hidden
    return truth, seen


def _relayed(
    seen: NDArray[np.float32],
    relays: Sequence[Relay],
    physics: str,
    draws: Draws,
    optics: Optics,
    faults: Faults,
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return the light (T, H, W, C) that reaches the camera, and what the bundle adds of its own in frame 0."""
    shading = np.float32(1) if optics.shading is None else optics.shading
    light = np.empty_like(seen)
    for shown, frame, relay in zip(light, seen, relays, strict=True):
        shown[:] = shading * (frame * relay.flat.astype(np.float32) if physics == "mask" else relay.through(frame))
    added = []
    for size, cores, unit in (
        (faults.background, draws.glow, draws.glow),
        (faults.offset, draws.offsets, np.ones_like(draws.offsets)),
    ):
        if size > 0:
            scale = size * light[:, optics.field].mean() / (shading * relays[0].emit(unit))[optics.field].mean()
            added.append(
                np.stack([np.broadcast_to(shading * relay.emit(scale * cores), seen.shape[1:]) for relay in relays])
            )
    glow = sum(added[1:], start=added[0]) if added else None
    if glow is not None:
        light += glow
    light *= draws.exposures.astype(np.float32)[:, None, None, None]
    return light, None if glow is None else glow[0]


def _photographed(
    light: NDArray[np.float32], camera: Camera, rng: np.random.Generator, draws: Draws, optics: Optics
) -> NDArray[Any]:
    """Return the numbers (T, H, W, C) that a recorder writes: the camera's, and what is burned in."""
    light[draws.black] = 0
    recorded = camera.record(light, rng)
    for number in draws.white:
        recorded[number, optics.field] = camera.full_scale
    recorded[:, optics.marks] = round(OVERLAY_LIGHT * camera.full_scale)
    return recorded


def _as_burst(recorded: NDArray[Any], white_level: float) -> Burst:
    """Return recorded frames (T, H, W, C) as a burst, grey ones without their channel axis."""
    is_grey = recorded.shape[3] == 1
    pixels, axes = (recorded[..., 0], "TYX") if is_grey else (recorded, "TYXC")
    return Burst(pixels, axes=axes, black_level=0, white_level=white_level)


def designed(bundle: Bundle, shape: tuple[int, int], contrast: float | None) -> RelayAt:
    """Return the relay of a bundle that was laid out."""
    fading = None if contrast is None else Fading.to(contrast, bundle.transmission(shape)[..., None], bundle)
    return lambda offset: relay_of_design(replace(bundle, centres=bundle.centres + offset), shape, fading)


def measured(flat: NDArray[np.float64], contrast: float | None, *, crosstalk: float = 0.0) -> RelayAt:
    """Return the relay of a bundle whose flat field (H, W, C) was measured."""
    bundle = find_bundle(flat, crosstalk)
    fading = None if contrast is None else Fading.to(contrast, flat, bundle)

    def relay_at(offset: NDArray[np.float64]) -> Relay:
        moved = moved_flat(flat, offset) if offset.any() else flat
        return relay_of_flat(moved, replace(bundle, centres=bundle.centres + offset), fading)

    return relay_at


def _motion(
    motion: str | ArrayLike, frames: int, shape: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.float64]:
    if isinstance(motion, str):
        if motion not in MOTIONS:
            raise SettingsError(f"unknown motion {motion!r}; known: {', '.join(MOTIONS)}, or homographies (T, 3, 3)")
        return MOTIONS[motion](frames, shape, rng)
    return as_homographies(motion, frames)


def as_homographies(given: ArrayLike, frames: int) -> NDArray[np.float64]:
    """Return homographies (T, 3, 3) that were given as such.

    Raises
    ------
    SettingsError
        They are of another shape, do not begin with the identity, or have no inverse.
    """
    homographies = np.array(given, dtype=np.float64)
    if homographies.shape != (frames, 3, 3):
        raise SettingsError(f"homographies must have shape {(frames, 3, 3)}; got {homographies.shape}")
    if not np.allclose(homographies[0], np.eye(3)) or not (np.abs(np.linalg.det(homographies)) > 1e-12).all():
        raise SettingsError("homographies must begin with the identity, and each must have an inverse")
    return homographies


def check_numbers(shape: tuple[int, int], frames: int, channels: int | None, seed: int) -> None:
    """Refuse sizes and counts that cannot be."""
    wanted = {"frames": (frames, 1), "channels": (1 if channels is None else channels, 1), "seed": (seed, 0)}
    if len(shape) != 2:
        raise SettingsError(f"shape must be (height, width); got {shape}")
    for name, (value, least) in {**wanted, "height": (shape[0], MIN_SIDE), "width": (shape[1], MIN_SIDE)}.items():
        if not isinstance(value, int | np.integer) or value < least:
            raise SettingsError(f"{name} must be an integer of at least {least}; got {value!r}")


def check_bundle(bundle: dict[str, Any], *, is_measured: bool) -> None:
    """Refuse settings that a bundle does not have."""
    known = ["crosstalk"] if is_measured else _BUNDLE_SETTINGS
    unknown = sorted(set(bundle) - set(known))
    if unknown:
        where = "a bundle given by its flat field" if is_measured else "the bundle"
        raise SettingsError(f"unknown setting {unknown[0]!r}; known of {where}: {', '.join(known)}")
