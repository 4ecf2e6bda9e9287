"""A fibre bundle: where its cores are, and what they do to the light."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.spatial import cKDTree
from scipy.special import erfc

from napari_fiberburst.errors import SettingsError

# Cores end in a Gaussian edge of this sigma, pixels.
_EDGE = 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class Bundle:
    """Cores in frame pixels; the bundle stands still while the object moves.

    Attributes
    ----------
    centres : numpy.ndarray
        (N, 2) as (x, y).
    radii : numpy.ndarray
        (N,) pixels.
    gains : numpy.ndarray
        (N,) part of the light that each core lets through; 0 for a dead one.
    pitch : float
        Mean distance of neighbours, pixels.
    crosstalk : float
        Part of a core's light that comes from its neighbours.
    """

    centres: NDArray[np.float64]
    radii: NDArray[np.float64]
    gains: NDArray[np.float64]
    pitch: float
    crosstalk: float

    def profiles(self, shape: tuple[int, int]) -> csr_array:
        """Return how bright each core at full gain shows in each pixel, (H * W, N): flat, with soft edges."""
        height, width = shape
        reach = math.ceil(self.radii.max() + 4 * _EDGE)
        offsets = np.arange(-reach, reach + 1)
        nearest = np.rint(self.centres).astype(int)
        columns = nearest[:, 0, None, None] + offsets[None, None, :]
        rows = nearest[:, 1, None, None] + offsets[None, :, None]
        distance = np.hypot(columns - self.centres[:, 0, None, None], rows - self.centres[:, 1, None, None])
        brightness = erfc((distance - self.radii[:, None, None]) / (math.sqrt(2) * _EDGE)) / 2
        shown = (brightness > 1e-4) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        cores, _, _ = np.nonzero(shown)
        pixels = (rows * width + columns)[shown]
        return csr_array((brightness[shown], (pixels, cores)), shape=(height * width, len(self.centres)))

    def transmission(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Return what the camera sees of an even white scene, (H, W) in [0, 1]."""
        image: NDArray[np.float64] = (self.profiles(shape) @ self.gains).reshape(shape)
        return np.minimum(image, 1)

    def mix(self, light: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return each core's light (N, C) with its neighbours' share in it."""
        if self.crosstalk == 0:
            return light
        mixed: NDArray[np.floating] = (1 - self.crosstalk) * light + self.crosstalk * (self._neighbours @ light)
        return mixed

    @cached_property
    def _neighbours(self) -> csr_array:
        """The mean over a core's neighbours, (N, N)."""
        first, second = cKDTree(self.centres).query_pairs(1.5 * self.pitch, output_type="ndarray").T
        links = csr_array((np.ones(len(first), np.float32), (first, second)), shape=(len(self.centres),) * 2)
        links = links + links.T
        return csr_array(diags_array(1 / np.maximum(links.sum(axis=1), 1)) @ links)


def make_bundle(
    shape: tuple[int, int],
    rng: Generator,
    *,
    pitch: float = 7.0,
    core_radius: float = 0.36,
    radius_spread: float = 0.08,
    jitter: float = 0.09,
    gain_spread: float = 0.15,
    dead_cores: float = 0.0,
    crosstalk: float = 0.03,
    outline: str = "frame",
) -> Bundle:
    """Lay out a hexagonal bundle at a random angle.

    Parameters
    ----------
    shape : (int, int)
        Height and width of a frame.
    rng : numpy.random.Generator
        Source of all that is irregular.
    pitch : float
        Distance of neighbouring cores, pixels; at least 2.
    core_radius : float
        In pitches; more than half makes cores touch.
    radius_spread, jitter, gain_spread : float
        Standard deviations: of the radius, relative; of the centres, in pitches; of the gain, relative.
    dead_cores : float
        Part of the cores that let no light through.
    crosstalk : float
        Part of a core's light that comes from its neighbours (physics "core" alone).
    outline : str
        "frame", cores everywhere, or "circle", cores in the circle that fits into the frame.

    Raises
    ------
    SettingsError
        A value is out of range.
    """
    for name, value, least, most in (
        ("pitch", pitch, 2.0, min(shape) / 4),
        ("core_radius", core_radius, 0.05, 0.7),
        ("dead_cores", dead_cores, 0.0, 0.9),
        ("radius_spread", radius_spread, 0.0, 0.5),
        ("jitter", jitter, 0.0, 0.5),
        ("gain_spread", gain_spread, 0.0, 0.4),
        ("crosstalk", crosstalk, 0.0, 1.0),
    ):
        if isinstance(value, str) or not least <= value <= most:
            raise SettingsError(f"{name} must be from {least:g} to {most:g}; got {value!r}")
    if outline not in ("frame", "circle"):
        raise SettingsError(f"unknown outline {outline!r}; known: frame, circle")
    centres = _hexagonal_lattice(shape, pitch, rng.uniform(0, math.pi / 3))
    centres = centres + rng.normal(0, jitter * pitch, centres.shape)
    height, width = shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    if outline == "circle":
        inside = np.hypot(*(centres - middle).T) <= min(shape) / 2 - pitch
    else:
        # Of a core whose centre is farther out, too little shows to say what light falls on it.
        inside = (np.abs(centres - middle) <= middle + 0.5 + 0.25 * core_radius * pitch).all(axis=1)
    centres = centres[inside]
    count = len(centres)
    radii = core_radius * pitch * np.clip(rng.normal(1, radius_spread, count), 0.5, 1.5)
    # Gains stand below 1 by two spreads, so that the brightest cores do not pass more light than there is.
    gains = np.clip(rng.normal(1 - 2 * gain_spread, gain_spread, count), 0.05, 1)
    gains[rng.random(count) < dead_cores] = 0
    return Bundle(centres=centres, radii=radii, gains=gains, pitch=pitch, crosstalk=crosstalk)


def _hexagonal_lattice(shape: tuple[int, int], pitch: float, angle: float) -> NDArray[np.float64]:
    """Return lattice points (N, 2) that cover a frame and more, turned by `angle` about its centre."""
    reach = math.ceil((math.hypot(*shape) / 2 + 2 * pitch) / (pitch * math.sqrt(3) / 2))
    first, second = (part.ravel() for part in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    # Rows are shifted by half a pitch in turn; taking the shift modulo a pitch keeps the patch square.
    x = pitch * (first + 0.5 * (second % 2))
    y = pitch * math.sqrt(3) / 2 * second
    cosine, sine = math.cos(angle), math.sin(angle)
    height, width = shape
    return np.stack([cosine * x - sine * y + (width - 1) / 2, sine * x + cosine * y + (height - 1) / 2], axis=1)
