"""Simulated recordings of any length: each frame is made when it is read, and its truth is exact."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.simulation.bundle import Bundle, make_bundle
from napari_fiberburst.simulation.camera import Camera
from napari_fiberburst.simulation.events import (
    cut,
    draw_bending,
    draw_cells,
    draw_cuts,
    draw_exposures,
    draw_lifts,
)
from napari_fiberburst.simulation.faults import Faults
from napari_fiberburst.simulation.field import make_optics
from napari_fiberburst.simulation.framing import Simulator, Views, World, fingerprint_of, pixels_of
from napari_fiberburst.simulation.motion import apply
from napari_fiberburst.simulation.paths import PATHS, follow
from napari_fiberburst.simulation.relay import Relay, prepared_flat
from napari_fiberburst.simulation.scenes import Reach, Scene, make_scene
from napari_fiberburst.simulation.simulate import (
    as_homographies,
    check_bundle,
    check_numbers,
    designed,
    measured,
)
from napari_fiberburst.simulation.slide import Slide

# As in `simulate`, and as a vendor's display shows it: with the cores filtered out.
RECORDED_PHYSICS = ("core", "mask", "filtered")
# Scenes that have no end.
ENDLESS_SCENES = ("slide", "fluorescence")
_SHAPE, _FRAMES, _PITCH = (256, 256), 400, 4.7
# The default step, in parts of the frame's shorter side.
_STEP = 0.035
# The default distance of a cut, in parts of the frame's longer side: nothing is seen in both frames.
_JUMP = 1.2
# Radius of a cell, in pitches.
_CELL_RADIUS = 0.75
# How far a spline sees beyond where it is sampled.
_SPLINE_REACH = 3
_STRIP = 128


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedRecording:
    """A recording and the truth behind it.

    Attributes
    ----------
    source : FrameSource
        The frames. Its reader makes each when it is read, to the same bits in any order and in any process.
    homographies : numpy.ndarray
        (T, 3, 3) float64, frame-t pixel to frame-0 pixel, [0] the identity.
    in_contact : numpy.ndarray
        (T,) bool: the probe touches the tissue. Elsewhere a frame is blurred and dim, or black.
    cuts : numpy.ndarray
        Numbers of the frames that show another place than the one before them.
    exposures : numpy.ndarray
        (T,) float64: what the light of each frame is multiplied by, geometric mean 1.
    cells : numpy.ndarray
        (M, 2) float64 as (x, y): where in frame-0 pixels cells blink.
    traces : numpy.ndarray
        (T, M) float32: the light that each cell adds to the scene in each frame, in parts of full scale.
    cell_radius : float
        Of a cell, pixels.
    transmission : numpy.ndarray
        (H, W) float64: what the camera sees of an even white scene, the mean of the channels.
    bundle : Bundle
        The cores.
    world : World
        The object, wherever the path leads.
    bounds : (float, float, float, float)
        x0, y0, x1, y1 in frame-0 pixels, half-open: what the frames see, all together.
    visible : numpy.ndarray or None
        (H, W) bool: inside the field and not under a burned-in mark; None where the whole frame is.
    """

    source: FrameSource
    homographies: NDArray[np.float64]
    in_contact: NDArray[np.bool_]
    cuts: NDArray[np.intp]
    exposures: NDArray[np.float64]
    cells: NDArray[np.float64]
    traces: NDArray[np.float32]
    cell_radius: float
    transmission: NDArray[np.float64]
    bundle: Bundle
    world: World
    bounds: tuple[float, float, float, float]
    visible: NDArray[np.bool_] | None
    _views: "Views"

    def truth(self, numbers: Sequence[int]) -> NDArray[np.float32]:
        """Return what the pixels of some frames look at (n, H, W, C): bent tissue, and cells as they blink.

        It is as it would be in contact, without bundle, exposure, marks and noise.
        """
        pixels = pixels_of((self.source.shape[1], self.source.shape[2]))
        return np.stack([self._views.look(number, pixels) for number in numbers])

    def displacement(self, number: int) -> NDArray[np.float32] | None:
        """Return how far tissue is bent in a frame, (H, W, 2) as (x, y) in pixels; None where it does not bend.

        The pixel x of frame t looks at the point ``homographies[t](x) + displacement(t)(x)`` of frame 0.
        """
        bending = self._views.bending
        if bending is None:
            return None
        return bending.at(
            number, apply(self.homographies[number], pixels_of((self.source.shape[1], self.source.shape[2])))
        )

    def picture(self, bounds: tuple[float, float, float, float], spacing: float = 1.0) -> NDArray[np.float32]:
        """Return the object itself (H', W', C), at rest and without cells.

        Parameters
        ----------
        bounds : (float, float, float, float)
            x0, y0, x1, y1 in frame-0 pixels, half-open: (0, 0, W, H) is frame 0's field.
        spacing : float
            Frame-0 pixels from one pixel of the picture to the next.

        Raises
        ------
        SettingsError
            The bounds are empty or the spacing is not positive.
        """
        x0, y0, x1, y1 = bounds
        if not (x0 < x1 and y0 < y1 and spacing > 0):
            raise SettingsError(f"a picture needs x0 < x1, y0 < y1 and a spacing above 0; got {bounds} and {spacing!r}")
        x, y = (
            start - 0.5 + spacing * (np.arange(max(1, round((stop - start) / spacing))) + 0.5)
            for start, stop in ((x0, x1), (y0, y1))
        )
        strips = [
            self.world.sample(np.stack(np.meshgrid(x, y[first : first + _STRIP]), axis=-1))
            for first in range(0, len(y), _STRIP)
        ]
        return np.concatenate(strips)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the truth that can be written beside the frames, as ``fiberburst simulate --recording`` does."""
        names = ("homographies", "in_contact", "cuts", "exposures", "cells", "traces", "transmission")
        return {name: getattr(self, name) for name in names} | {"core_centres": self.bundle.centres}


def simulate_recording(
    scene: str | World = "slide",
    *,
    frames: int | None = None,
    shape: tuple[int, int] | None = None,
    channels: int = 1,
    path: str | ArrayLike = "raster",
    step: float | None = None,
    laps: int = 1,
    turn: float = 0.0,
    zoom: float = 0.0,
    gaps: int = 0,
    gap_frames: int = 12,
    jumps: int = 0,
    jump: float | None = None,
    bending: float = 0.0,
    flicker: float = 0.0,
    drift: float = 0.0,
    cells: int = 0,
    flash: float = 0.3,
    flash_frames: int = 3,
    field: float | None = None,
    overlay: bool = False,
    vignette: float = 1.0,
    physics: str = "core",
    camera: Camera | None = None,
    flat: ArrayLike | None = None,
    rate: float = 25.0,
    seed: int = 0,
    **bundle: Any,
) -> SimulatedRecording:
    """Simulate a recording of any length, of which each frame is made when it is read.

    Parameters
    ----------
    scene : str or World
        "slide", drawn tissue without end, and "fluorescence", the same on black; one of `SCENES`, as far as it reaches;
        or a scene of your own.
    frames : int, optional
        T. Default 400, or as many as `path` has homographies.
    shape : (int, int), optional
        Height and width of a frame. Default 256 x 256, or all of `flat`.
    channels : int
        1 is grey; others are bands spread over the scene's spectrum.
    path : str or array_like
        "raster", "spiral", "handheld", or homographies (T, 3, 3), frame-t pixel to frame-0 pixel.
    step : float, optional
        Pixels from frame to frame. Default, 0.035 of the frame's shorter side.
    laps : int
        How many times the path is gone: forth, back, forth and so on.
    turn : float
        Degrees by which the probe turns at most, on the way.
    zoom : float
        The same of the magnification, relative: 0.02 is two per cent.
    gaps, gap_frames : int
        How often the probe loses contact, and for how many frames: it is lifted, sees nothing, and comes back.
    jumps : int
        How often the recording is cut, and goes on at another place.
    jump : float, optional
        How far away that is, pixels. Default, 1.2 of the frame's longer side, so that nothing is seen in both frames.
    bending : float
        By how much tissue bends over the recording, pixels root mean square where it is most; frame 0 is at rest.
    flicker : float
        Relative standard deviation of the exposures from frame to frame.
    drift : float
        By how much the light changes slowly, relative, at most.
    cells : int
        How many cells blink at places that the probe passes, discs of 1.5 pitches across.
    flash : float
        The light of a flash, in parts of full scale, which is added to the scene's.
    flash_frames : int
        Frames of a flash.
    field, overlay, vignette
        A round field, burned-in marks, darkening to the rim: as in `Faults`.
    physics : str
        "core" and "mask" as in `simulate`; "filtered" is "core" as vendors show it, with the core pattern filtered out.
    camera : Camera, optional
        Default, 8 bits with one per cent of noise at full scale.
    flat : array_like, optional
        As in `simulate`.
    rate : float
        Frames per second.
    seed : int
        The same seed gives the same recording.
    **bundle
        As in `simulate`; ``pitch`` is 4.7 by default.

    Returns
    -------
    SimulatedRecording

    Raises
    ------
    SettingsError
        An unknown scene, path or physics, a value out of range, or a path that leads out of the scene.
    """
    if physics not in RECORDED_PHYSICS:
        raise SettingsError(f"unknown physics {physics!r}; known: {', '.join(RECORDED_PHYSICS)}")
    size = shape or (_SHAPE if flat is None else (np.shape(flat)[0], np.shape(flat)[1]))
    count = frames if frames is not None else (_FRAMES if isinstance(path, str) else len(np.asarray(path)))
    check_numbers(size, count, channels, seed)
    check_bundle(bundle, is_measured=flat is not None)
    _check_counts(laps=laps, gaps=gaps, gap_frames=gap_frames, jumps=jumps, cells=cells, flash_frames=flash_frames)
    _check_amounts(step=step, turn=turn, zoom=zoom, jump=jump, bending=bending, drift=drift, flash=flash, rate=rate)
    # The first four as in `simulate`, so that the same seed lays out the same bundle.
    scene_rng, path_rng, bundle_rng, camera_rng, event_rng = np.random.default_rng(seed).spawn(5)
    jump_rng, contact_rng, light_rng, bend_rng, cell_rng = event_rng.spawn(5)
    cuts = draw_cuts(count, jumps, jump_rng)
    smooth = _path(path, count, size, path_rng, step=step, laps=laps, turn=turn, zoom=zoom)
    homographies = cut(smooth, cuts, _JUMP * max(size) if jump is None else jump, jump_rng)
    bent = draw_bending(count, bending, size, bend_rng)
    bounds = _bounds(homographies, size, 0.0 if bent is None else bent.most)
    relay = _relay(flat, size, channels, bundle_rng, bundle)
    radius = _CELL_RADIUS * relay.bundle.pitch
    simulator = Simulator(
        views=Views(
            world=_world(scene, size, channels, bounds, scene_rng),
            homographies=homographies,
            bending=bent,
            cells=draw_cells(cells, homographies, size, cell_rng, radius=radius, flash=flash, length=flash_frames),
        ),
        relay=relay,
        optics=make_optics(
            Faults(flicker=flicker, field=field, overlay=overlay, vignette=vignette),
            size,
            channels,
            is_circle=bundle.get("outline") == "circle",
        ),
        physics=physics,
        camera=camera or Camera(),
        exposures=draw_exposures(count, flicker, drift, light_rng),
        lifts=draw_lifts(count, gaps, gap_frames, contact_rng),
        channels=channels,
        seed=int(camera_rng.integers(2**63)),
    )
    what = scene if isinstance(scene, str) else type(scene).__name__
    name = f"simulated {what}, {path if isinstance(path, str) else 'path given'}"
    return _recording(simulator, name, cuts, bounds, rate)


def _relay(
    flat: ArrayLike | None, shape: tuple[int, int], channels: int, rng: np.random.Generator, bundle: dict[str, Any]
) -> Relay:
    """Return what becomes of light in a bundle that is laid out, or was measured."""
    if flat is None:
        relay_at = designed(make_bundle(shape, rng, **{"pitch": _PITCH, **bundle}), shape, None)
    else:
        relay_at = measured(prepared_flat(flat, shape, channels), None, **bundle)
    return relay_at(np.zeros(2))


def _recording(
    simulator: Simulator,
    name: str,
    cuts: NDArray[np.intp],
    bounds: tuple[float, float, float, float],
    rate: float,
) -> SimulatedRecording:
    """Return a recording of what a simulator makes."""
    views, relay, optics = simulator.views, simulator.relay, simulator.optics
    count = len(views.homographies)
    some = simulator([0, count // 2, count - 1])
    acquisition = Acquisition(
        shape=(count, *some.shape[1:3], simulator.channels),
        axes="TYX" if simulator.channels == 1 else "TYXC",
        dtype=some.dtype,
        black_level=0.0,
        white_level=float(simulator.camera.full_scale),
        times=np.arange(count) / rate,
    )
    fingerprint = fingerprint_of(simulator, some, rate)
    is_filtered = simulator.physics == "filtered"
    flat = np.where(optics.field[..., None], 1.0, 0.0) if is_filtered else relay.flat
    return SimulatedRecording(
        source=FrameSource(acquisition=acquisition, reader=simulator, name=name, fingerprint=fingerprint),
        homographies=views.homographies,
        in_contact=simulator.lifts == 0,
        cuts=cuts,
        exposures=simulator.exposures,
        cells=np.zeros((0, 2)) if views.cells is None else views.cells.places,
        traces=np.zeros((count, 0), np.float32) if views.cells is None else views.cells.traces,
        cell_radius=_CELL_RADIUS * relay.bundle.pitch,
        transmission=(flat if optics.shading is None else flat * optics.shading).mean(axis=2),
        bundle=relay.bundle,
        world=views.world,
        bounds=bounds,
        visible=optics.visible,
        _views=views,
    )


def _path(
    path: str | ArrayLike,
    frames: int,
    shape: tuple[int, int],
    rng: np.random.Generator,
    *,
    step: float | None,
    laps: int,
    turn: float,
    zoom: float,
) -> NDArray[np.float64]:
    if isinstance(path, str):
        if path not in PATHS:
            raise SettingsError(f"unknown path {path!r}; known: {', '.join(PATHS)}, or homographies (T, 3, 3)")
        step = _STEP * min(shape) if step is None else step
        return follow(path, frames, shape, rng, step=step, laps=laps, turn=turn, zoom=zoom)
    if (laps, turn, zoom, step) != (1, 0, 0, None):
        raise SettingsError("step, laps, turn and zoom are of named paths; homographies hold all of the motion")
    return as_homographies(path, frames)


def _bounds(
    homographies: NDArray[np.float64], shape: tuple[int, int], bending: float
) -> tuple[float, float, float, float]:
    """Return x0, y0, x1, y1 of all that frames look at, half-open."""
    height, width = shape
    corners = np.array([[x, y, 1.0] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    mapped = homographies @ corners.T
    if (mapped[:, 2] <= 0).any():
        raise SettingsError("homographies must keep frames whole; one of them maps a part of the frame to infinity")
    points = mapped[:, :2] / mapped[:, 2:]
    low, high = points.min(axis=(0, 2)) - bending, points.max(axis=(0, 2)) + bending
    return float(low[0]) + 0.5, float(low[1]) + 0.5, float(high[0]) + 0.5, float(high[1]) + 0.5


def _world(
    scene: str | World,
    shape: tuple[int, int],
    channels: int,
    bounds: tuple[float, float, float, float],
    rng: np.random.Generator,
) -> World:
    """Return what there is to see within these bounds, in so many channels."""
    if isinstance(scene, str) and scene in ENDLESS_SCENES:
        return Slide(seed=int(rng.integers(2**31)), channels=channels, glows=scene == "fluorescence")
    x0, y0, x1, y1 = bounds
    if isinstance(scene, str):
        before = [max(0, math.ceil(-edge)) + _SPLINE_REACH for edge in (x0, y0)]
        after = [max(0, math.ceil(edge - side)) + _SPLINE_REACH for edge, side in ((x1, shape[1]), (y1, shape[0]))]
        reach: Reach = (before[0], before[1], after[0], after[1])
        return make_scene(scene, shape, rng, reach).with_channels(channels)
    if isinstance(scene, Scene):
        height, width = scene.image.shape[:2]
        left, top = (start + edge for start, edge in zip(scene.origin, (x0, y0), strict=True))
        right, bottom = scene.origin[0] + x1, scene.origin[1] + y1
        if min(left, top) < 0 or right > width or bottom > height:
            raise SettingsError(
                f"the path needs the scene's columns {left:.0f} to {right:.0f} and rows {top:.0f} to {bottom:.0f}, but "
                f"it has {height} x {width} pixels; take fewer frames, smaller steps, or the scene 'slide'"
            )
        return scene.with_channels(channels)
    if scene.channels != channels:
        raise SettingsError(f"the scene has {scene.channels} channels; got channels={channels}")
    return scene


def _check_counts(**counts: int) -> None:
    for name, value in counts.items():
        least = 0 if name in ("gaps", "jumps", "cells") else 1
        if not isinstance(value, int | np.integer) or value < least:
            raise SettingsError(f"{name} must be an integer of at least {least}; got {value!r}")


def _check_amounts(**amounts: float | None) -> None:
    for name, value in amounts.items():
        if value is not None and (isinstance(value, str) or not 0 <= value < math.inf):
            raise SettingsError(f"{name} must be a number of at least 0; got {value!r}")
    if amounts["rate"] == 0:
        raise SettingsError("rate must be above 0 frames per second; got 0")
