"""What a bundle, designed or measured, makes of the light that falls on it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.ndimage import shift as shift_image
from scipy.optimize import brentq
from scipy.sparse import csr_array, diags_array
from scipy.spatial import cKDTree

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.simulation.bundle import Bundle

# A measured pixel belongs to its nearest core where that is so many pitches away at most.
_CELL_REACH = 0.7
# The quantile of a measured flat field that passes all light: the brightest pixels are often dirt.
_BRIGHTEST = 0.999
# A bundle's inside, where its contrast is measured: where the local mean is at least this part of its median.
_INSIDE = 0.7
# Pitches over which a flat field is blurred to become even.
_EVEN_OVER = 3.0
# Cores of irregular bundles lie at least so many pitches apart.
_APART = 0.4
_FEWEST_CORES = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class Relay:
    """A bundle in front of a camera: cores gather, mix, and emit.

    Attributes
    ----------
    bundle : Bundle
        The cores.
    flat : numpy.ndarray
        (H, W, C) or (H, W, 1) float64 in [0, 1]: what the camera sees of an even white scene.
    gathering : scipy.sparse.csr_array
        (H * W, N) float32: how much of each pixel's light each core takes, not yet divided by their sum.
    emission : scipy.sparse.csr_array
        (H * W, N) float32: how bright each core shows in each pixel.
    gains : numpy.ndarray
        (N, 1) float32: part of the light that each core lets through, where `emission` does not have it.
    tint : numpy.ndarray or None
        (H, W, C) or (H, W, 1) float32: what the emitted light is multiplied by, per pixel.
    """

    bundle: Bundle
    flat: NDArray[np.float64]
    gathering: csr_array
    emission: csr_array
    gains: NDArray[np.float32]
    tint: NDArray[np.float32] | None = None

    def through(self, frame: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the camera sees of a frame (H, W, C): one value a core."""
        area = np.maximum(self.gathering.sum(axis=0), np.finfo(np.float32).tiny)[:, None]
        gathered = (self.gathering.T @ frame.reshape(-1, frame.shape[2])) / area
        return self.emit(self.bundle.mix(gathered))

    def emit(self, light: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return what the camera sees (H, W, C) of the cores' light (N, C)."""
        height, width = self.flat.shape[:2]
        seen: NDArray[np.float32] = (self.emission @ (light * self.gains)).reshape(height, width, -1)
        return seen if self.tint is None else seen * self.tint


@dataclass(frozen=True)
class Fading:
    """How a flat field is mixed with an even one: `level` x (`part` x flat + (1 - `part`) x even)."""

    part: float
    level: float

    @classmethod
    def to(cls, contrast: float, flat: NDArray[np.float64], bundle: Bundle) -> "Fading":
        """Return the fading that gives a flat field (H, W, C) this local contrast, and 1 as its greatest value.

        Raises
        ------
        SettingsError
            The flat field has less contrast, or even the even one has more.
        """
        even = even_flat(flat, bundle)

        def mixed(part: float) -> NDArray[np.float64]:
            return part * flat + (1 - part) * even

        least, most = (local_contrast(mixed(part), bundle.pitch) for part in (0.0, 1.0))
        if not least <= contrast <= most:
            raise SettingsError(
                f"contrast must be from {least:.3f} to {most:.3f}, that of the bundle itself; got {contrast:g}"
            )
        part = float(brentq(lambda part: local_contrast(mixed(part), bundle.pitch) - contrast, 0, 1, xtol=1e-6))
        return cls(part, 1 / float(mixed(part).max()))

    def of(self, flat: NDArray[np.float64], bundle: Bundle) -> NDArray[np.float64]:
        """Return the faded flat field (H, W, C)."""
        faded = self.level * (self.part * flat + (1 - self.part) * even_flat(flat, bundle))
        return np.minimum(faded, 1)


def local_contrast(flat: NDArray[np.float64], pitch: float) -> float:
    """Return the standard deviation of a flat field (H, W, C) over its local mean, inside the bundle, all channels."""
    mean = gaussian_filter(flat, (pitch, pitch, 0))
    inside = mean >= _INSIDE * np.median(mean[mean > 0.1 * mean.max()])
    return float((flat[inside] / mean[inside]).std())


def even_flat(flat: NDArray[np.float64], bundle: Bundle) -> NDArray[np.float64]:
    """Return a flat field (H, W, C) without cores, as bright as the bundle is thereabouts, and 0 outside it."""
    shape = flat.shape[0], flat.shape[1]
    _, distance = _cells(bundle.centres, shape)
    near = (distance <= _CELL_REACH * bundle.pitch).reshape(*shape, 1).astype(np.float64)
    inside = (gaussian_filter(near, (bundle.pitch, bundle.pitch, 0)) > 0.5).astype(np.float64)  # with gaps closed
    width = (_EVEN_OVER * bundle.pitch, _EVEN_OVER * bundle.pitch, 0)
    mean = gaussian_filter(flat * inside, width) / np.maximum(gaussian_filter(inside, width), 1e-6)
    even: NDArray[np.float64] = mean * inside
    return even


def relay_of_design(bundle: Bundle, shape: tuple[int, int], fading: Fading | None) -> Relay:
    """Return what becomes of light in a bundle that was laid out."""
    profiles = bundle.profiles(shape)
    single = profiles.astype(np.float32)
    flat = np.minimum((profiles @ bundle.gains).reshape(*shape, 1), 1)
    if fading is None:
        gains = bundle.gains[:, None].astype(np.float32)
        return Relay(bundle=bundle, flat=flat, gathering=single, emission=single, gains=gains)
    cells, _ = _cells(bundle.centres, shape)
    even = diags_array(even_flat(flat, bundle).ravel()) @ cells
    honeycomb = profiles @ diags_array(bundle.gains)
    emission = fading.level * (fading.part * honeycomb + (1 - fading.part) * even)
    return Relay(
        bundle=bundle,
        flat=fading.of(flat, bundle),
        gathering=single,
        emission=csr_array(emission.astype(np.float32)),
        gains=np.ones((len(bundle.centres), 1), np.float32),
    )


def relay_of_flat(flat: NDArray[np.float64], bundle: Bundle, fading: Fading | None) -> Relay:
    """Return what becomes of light in a bundle whose flat field (H, W, C) was measured.

    A core's emission profile is the flat field in its cell; it gathers light by the square of that profile. What is no
    core's cell is dark.
    """
    shape = flat.shape[0], flat.shape[1]
    cells, distance = _cells(bundle.centres, shape)
    inside = (distance <= _CELL_REACH * bundle.pitch).reshape(*shape, 1)
    profile = (flat.mean(axis=2, keepdims=True) * inside).ravel()
    shown = (flat if fading is None else fading.of(flat, bundle)) * inside
    return Relay(
        bundle=bundle,
        flat=shown,
        gathering=csr_array(diags_array(profile**2) @ cells).astype(np.float32),
        emission=cells.astype(np.float32),
        gains=np.ones((len(bundle.centres), 1), np.float32),
        tint=shown.astype(np.float32),
    )


def moved_flat(flat: NDArray[np.float64], offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a flat field (H, W, C) moved by an offset (x, y) in pixels, reflected at the frame's edges."""
    moved = shift_image(flat, (offset[1], offset[0], 0), order=3, mode="mirror")
    return np.clip(moved, 0, 1)


def prepared_flat(flat: ArrayLike, shape: tuple[int, int] | None, channels: int) -> NDArray[np.float64]:
    """Return a measured flat field as (H, W, C) or (H, W, 1) in [0, 1], cropped to `shape` about its middle.

    Raises
    ------
    SettingsError
        It is no image, has other channels than the scene, is smaller than `shape`, or is dark.
    """
    image = np.asarray(flat, dtype=np.float64)
    image = image[..., None] if image.ndim == 2 else image
    if image.ndim != 3 or image.shape[2] not in (1, channels):
        raise SettingsError(
            f"flat must be an image (H, W), or (H, W, {channels}) as the scene has {channels} channel(s); "
            f"got shape {np.shape(flat)}"
        )
    height, width = shape or image.shape[:2]
    if height > image.shape[0] or width > image.shape[1]:
        raise SettingsError(f"shape must fit into flat, {image.shape[0]} x {image.shape[1]}; got {height} x {width}")
    y0, x0 = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    image = image[y0 : y0 + height, x0 : x0 + width]
    brightest = np.quantile(image, _BRIGHTEST) if np.isfinite(image).all() and image.min() >= 0 else 0.0
    if brightest <= 0:
        raise SettingsError("flat must hold finite intensities of at least 0, and not only zeros")
    return np.clip(image / brightest, 0, 1)


def find_bundle(flat: NDArray[np.float64], crosstalk: float) -> Bundle:
    """Return the cores that a flat field (H, W, C) shows: local maxima, far enough from one another.

    Their radii are those of discs as large as the part of a cell that shines at least half as bright as its core.

    Raises
    ------
    SettingsError
        No cores are seen, or `crosstalk` is not in [0, 1].
    """
    if not 0 <= crosstalk <= 1:
        raise SettingsError(f"crosstalk must be from 0 to 1; got {crosstalk!r}")
    grey = flat.mean(axis=2)
    pitch = _pitch(grey)
    smooth = gaussian_filter(grey, 0.18 * pitch)
    reach = math.floor(max(1.0, _APART * pitch))
    rows, columns = np.indices((2 * reach + 1, 2 * reach + 1)) - reach
    disc = np.hypot(rows, columns) <= max(1.0, _APART * pitch)
    mean = gaussian_filter(grey, pitch)
    peaks = (smooth == maximum_filter(smooth, footprint=disc)) & (smooth > 0.5 * mean) & (mean > 0.1 * mean.max())
    peaks &= smooth - minimum_filter(smooth, footprint=disc) > 1e-3 * mean  # an even image has none
    y, x = np.nonzero(peaks)
    if len(x) < _FEWEST_CORES:
        raise SettingsError(
            f"flat must show the cores of a bundle; {len(x)} were found: give an image of the bundle in even light"
        )
    centres = np.stack([x + _vertex(smooth, y, x, 0, 1), y + _vertex(smooth, y, x, 1, 0)], axis=1)
    gains = smooth[y, x]
    cells, distance = _cells(centres, (grey.shape[0], grey.shape[1]))
    is_bright = (grey.ravel() >= 0.5 * (cells @ gains)) & (distance <= _CELL_REACH * pitch)
    radii = np.sqrt(np.maximum(cells.T @ is_bright.astype(np.float64), 1) / math.pi)
    return Bundle(centres=centres, radii=radii, gains=gains, pitch=pitch, crosstalk=crosstalk)


def _pitch(grey: NDArray[np.float64]) -> float:
    """Return the distance of neighbouring cores in pixels: a hexagonal lattice's ring in the power spectrum."""
    height, width = grey.shape
    window = np.outer(np.hanning(height), np.hanning(width))
    power = np.abs(np.fft.rfft2(window * (grey - grey.mean()))) ** 2
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :])
    side = min(height, width)
    ring = np.rint(frequency * side).astype(int).ravel()
    summed = np.bincount(ring, power.ravel())  # a sum over each ring: single low frequencies do not count for more
    slowest, fastest = max(4, side // 40), side // 2
    return float(2 / math.sqrt(3) * side / (slowest + np.argmax(summed[slowest : fastest + 1])))


def _vertex(
    image: NDArray[np.float64], rows: NDArray[np.intp], columns: NDArray[np.intp], down: int, across: int
) -> NDArray[np.float64]:
    """Return how far the vertex of the parabola through each pixel and its two neighbours lies from the pixel."""
    padded = np.pad(image, 1, mode="edge")
    before = padded[rows + 1 - down, columns + 1 - across]
    after = padded[rows + 1 + down, columns + 1 + across]
    bend = 2 * image[rows, columns] - before - after
    offset = np.divide(after - before, 2 * bend, out=np.zeros(len(rows)), where=bend > 0)
    return np.clip(offset, -0.5, 0.5)


def _cells(centres: NDArray[np.float64], shape: tuple[int, int]) -> tuple[csr_array, NDArray[np.float64]]:
    """Return which core is nearest to each pixel, as a matrix (H * W, N) of ones, and how far it is (H * W,)."""
    rows, columns = np.indices(shape)
    points = np.stack([columns.ravel(), rows.ravel()], axis=1)
    distance, nearest = (np.asarray(found) for found in cKDTree(centres).query(points))
    size = len(points)
    return csr_array((np.ones(size), (np.arange(size), nearest)), shape=(size, len(centres))), distance
