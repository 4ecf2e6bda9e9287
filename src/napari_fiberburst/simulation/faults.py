"""What recorded bursts suffer from, each behind its own switch, and the random draws that make it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.settings.parameter import check, parameter

# Relative standard deviation, among cores, of the light that a bundle adds.
_BACKGROUND_SPREAD = 0.3
# Positions over which the light of a smeared frame is averaged.
_SMEAR_POSES = 5


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What is wrong with a recording; every fault is off by default and independent of the others.

    Raises
    ------
    SettingsError
        A value is out of range.
    """

    flicker: float = parameter(
        0.0, "Relative standard deviation of the frames' exposures; more makes frames differ more.", least=0, most=1
    )
    deformation: float = parameter(
        0.0, "How far the object bends from frame to frame, pixels rms; frame 0 is the shape at rest.", least=0
    )
    deformation_length: float = parameter(
        90.0, "Distance at which the bending's correlation has fallen to 1/e, pixels; less bends locally.", least=4
    )
    smear: float = parameter(
        0.0, "Part of the way to the next frame's position over which a frame is exposed; more blurs.", least=0, most=1
    )
    background: float = parameter(
        0.0, "Light of the bundle itself, in parts of the mean light from the object; more dulls.", least=0, most=20
    )
    offset: float = parameter(
        0.0,
        "Light that each core shows by itself, root mean square in parts of the mean light; more adds dots.",
        least=0,
        most=5,
    )
    vignette: float = parameter(1.0, "How many times darker the rim is than the middle; 1 is even.", least=1, most=100)
    field: float | None = parameter(
        None,
        "Radius of a round field on black, in parts of half the shorter side; None shows the whole frame.",
        least=0.1,
        most=1,
    )
    overlay: bool = parameter(False, "Burn a logo, a scale bar and a mark into all frames.")
    intruder: float = parameter(
        0.0, "Part of the field that a bright thing covers, which moves unlike the object.", least=0, most=0.5
    )
    intruder_frames: float = parameter(
        1 / 3, "Part of the frames, consecutive and without frame 0, in which the intruder is seen.", above=0, most=1
    )
    black_frames: int = parameter(0, "Frames without light; never frame 0.", least=0)
    white_frames: int = parameter(0, "Saturated frames; never frame 0.", least=0)
    bundle_shift: float = parameter(
        0.0, "How far the bundle moves on the camera, once, at half of the burst, pixels.", least=0
    )
    contrast: float | None = parameter(
        None,
        "Local standard deviation of the bundle's flat field over its local mean; less makes a faint bundle, "
        "None leaves it as it is.",
        above=0,
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, kw_only=True, eq=False)
class Draws:
    """What chance makes of faults in one burst.

    Attributes
    ----------
    exposures : numpy.ndarray
        (T,) float64, geometric mean 1.
    displacement : numpy.ndarray or None
        (T, H, W, 2) float32, (x, y) in pixels: how far each pixel's scene point is displaced.
    hidden : numpy.ndarray or None
        (T, H, W) float32 in [0, 1]: how far an intruder hides each pixel.
    black, white : numpy.ndarray
        Numbers of the black and of the saturated frames.
    bundle_offsets : numpy.ndarray
        (T, 2) float64: how far the bundle has moved on the camera, (x, y) in pixels.
    glow : numpy.ndarray
        (N, 1) float32: how much of the background's light each core adds, about 1.
    offsets : numpy.ndarray
        (N, 1) float32: how much light each core shows beyond that, root mean square 1.
    """

    exposures: NDArray[np.float64]
    displacement: NDArray[np.float32] | None
    hidden: NDArray[np.float32] | None
    black: NDArray[np.intp]
    white: NDArray[np.intp]
    bundle_offsets: NDArray[np.float64]
    glow: NDArray[np.float32]
    offsets: NDArray[np.float32]

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which frames (T,) are neither black nor white."""
        return ~np.isin(np.arange(len(self.exposures)), [*self.black, *self.white])


def draw(faults: Faults, frames: int, field: NDArray[np.bool_], radius: float, cores: int, rng: Generator) -> Draws:
    """Draw what chance makes of these faults; each fault has its own generator, so that none disturbs another.

    Parameters
    ----------
    faults : Faults
        What is wrong, and how much.
    frames : int
        T.
    field : numpy.ndarray
        (H, W) bool: where something of the object is seen.
    radius : float
        Of the circle about the frame's middle in which an intruder stays, pixels.
    cores : int
        N.
    rng : numpy.random.Generator
        Source of all draws.

    Raises
    ------
    SettingsError
        More frames are to be black or white than there are beside frame 0.
    """
    flicker_rng, bend_rng, intruder_rng, frames_rng, shift_rng, glow_rng, offset_rng = rng.spawn(7)
    black, white = _draw_unusable(faults, frames, frames_rng)
    return Draws(
        exposures=_draw_exposures(faults, frames, flicker_rng),
        displacement=_draw_displacement(faults, frames, field, bend_rng),
        hidden=_draw_intruder(faults, frames, field, radius, intruder_rng),
        black=black,
        white=white,
        bundle_offsets=_draw_bundle_offsets(faults, frames, shift_rng),
        glow=np.maximum(glow_rng.normal(1, _BACKGROUND_SPREAD, (cores, 1)), 0).astype(np.float32),
        offsets=np.abs(offset_rng.standard_normal((cores, 1))).astype(np.float32),
    )


def _draw_exposures(faults: Faults, frames: int, rng: Generator) -> NDArray[np.float64]:
    """Return every frame's exposure (T,): log-normal, geometric mean 1."""
    logarithms = rng.normal(0, math.sqrt(math.log1p(faults.flicker**2)), frames)
    exposures: NDArray[np.float64] = np.exp(logarithms - logarithms.mean())
    return exposures


def _draw_displacement(
    faults: Faults, frames: int, field: NDArray[np.bool_], rng: Generator
) -> NDArray[np.float32] | None:
    """Return how far each pixel's scene point is displaced (T, H, W, 2) in (x, y), pixels; None without deformation.

    Frame 0 is the shape at rest; every other one is an independent smooth field whose root mean square over `field`
    (H, W) is `faults.deformation`.
    """
    if faults.deformation == 0:
        return None
    height, width = field.shape
    # A Gaussian filter of this sigma gives white noise a correlation of exp(-distance^2 / (4 sigma^2)).
    sigma = faults.deformation_length / 2
    across, down = _gaussians(width, sigma), _gaussians(height, sigma)
    noise = rng.standard_normal((frames, 2, down.shape[1], across.shape[1]))
    displacement = np.moveaxis(down @ noise @ across.T, 1, -1)
    lengths = np.sqrt((displacement[:, field] ** 2).sum(axis=-1).mean(axis=-1))
    displacement *= (faults.deformation / lengths)[:, None, None, None]
    displacement[0] = 0
    return displacement.astype(np.float32)


def _draw_unusable(faults: Faults, frames: int, rng: Generator) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the numbers of the black and of the white frames.

    Raises
    ------
    SettingsError
        There are not so many frames beside frame 0.
    """
    black, white = faults.black_frames, faults.white_frames
    if black + white > frames - 1:
        raise SettingsError(
            f"black_frames and white_frames must leave frame 0, so at most {frames - 1} of {frames} frames can be "
            f"either; got {black} and {white}"
        )
    chosen = 1 + rng.permutation(frames - 1)
    return np.sort(chosen[:black]), np.sort(chosen[black : black + white])


def _draw_intruder(
    faults: Faults, frames: int, field: NDArray[np.bool_], radius: float, rng: Generator
) -> NDArray[np.float32] | None:
    """Return how far an intruder hides each pixel (T, H, W), in [0, 1]; None without one.

    It crosses a field (H, W) of this radius about the frame's middle along a straight line, at even speed, as a disc
    that stays inside where it is small enough.
    """
    count = min(frames - 1, max(1, round(faults.intruder_frames * frames)))
    if faults.intruder == 0 or count == 0:
        return None
    size = math.sqrt(faults.intruder * field.sum() / math.pi)
    reach = max(0.0, radius - size)
    start = rng.uniform(0, 2 * math.pi)
    end = start + math.pi + rng.uniform(-1, 1)
    first = rng.integers(1, frames - count + 1)
    height, width = field.shape
    rows, columns = np.indices(field.shape, dtype=np.float64)
    hidden = np.zeros((frames, height, width), np.float32)
    for number, part in enumerate(np.linspace(0, 1, count)):
        x = reach * ((1 - part) * math.cos(start) + part * math.cos(end)) + (width - 1) / 2
        y = reach * ((1 - part) * math.sin(start) + part * math.sin(end)) + (height - 1) / 2
        hidden[first + number] = np.clip(size + 0.5 - np.hypot(columns - x, rows - y), 0, 1)
    return hidden


def _draw_bundle_offsets(faults: Faults, frames: int, rng: Generator) -> NDArray[np.float64]:
    """Return how far the bundle has moved on the camera in each frame (T, 2), (x, y) in pixels."""
    angle = rng.uniform(0, 2 * math.pi)
    offsets = np.zeros((frames, 2))
    offsets[(frames + 1) // 2 :] = faults.bundle_shift * np.array([math.cos(angle), math.sin(angle)])
    return offsets


def exposed_over(here: NDArray[np.float64], step: NDArray[np.float64], smear: float) -> list[NDArray[np.float64]]:
    """Return the scene points (H, W, 2) that a frame sees one after the other while it is exposed.

    Parameters
    ----------
    here, step : numpy.ndarray
        (H, W, 2), where each pixel looks in the middle of the exposure, and how far the next frame's look is from it.
    smear : float
        Part of the step over which the exposure lasts.
    """
    return [here + part * step for part in np.linspace(-smear / 2, smear / 2, _SMEAR_POSES)]


def _gaussians(length: int, sigma: float) -> NDArray[np.float64]:
    """Return a Gaussian filter (length, M) from M points half a sigma apart, which are more than enough for it."""
    spacing = sigma / 2
    beyond = math.ceil(4 * sigma / spacing)
    points = spacing * np.arange(-beyond, math.ceil(length / spacing) + beyond + 1)
    matrix: NDArray[np.float64] = np.exp(-((np.arange(length)[:, None] - points) ** 2) / (2 * sigma**2))
    return matrix
