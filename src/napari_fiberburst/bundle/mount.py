"""Follow a bundle that moves on the camera within a burst: its honeycomb tells by how much, frame by frame.

Near the ring that the lattice draws in the spectrum, a frame shows the bundle and little of the object, and the pattern
of a real bundle is irregular enough to tell where it is beyond half a pitch. Frames are correlated there, each with the
mean of those before it and then with the mean of all others. The bundle has moved where that mean holds more power
than the mean of the frames as they are.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.ndimage import shift
from torch import Tensor

from napari_fiberburst.bundle.pitch import find_pitch, ring_frequency
from napari_fiberburst.bundle.samples import Samples, exposed
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.filters import blur

# Pixels, how far the bundle may have moved since the frames before.
MOST_OFFSET = 4
# A bundle is looked for in so many frames, evenly taken, and must be seen in most of them.
_PITCH_FRAMES = 3
# Pixels to a side of the middle of the frames that is looked at; it holds hundreds of cores.
_MOST_SIDE = 160
# In pitches: over this much the slow changes of a frame are divided out; and the part of the usual light that a place
# has at least.
_ENVELOPE, _LEAST_LIGHT = 0.5, 0.02
# The honeycomb is everywhere and bright points of an object are not, so what differs from its surroundings by more than
# so many times what is usual is cut off.
_MOST_OF_USUAL = 2.0
# Frequencies looked at, in parts of the ring's.
_BAND = (0.8, 2.1)
# The ring, and what is compared with it, in the same parts.
_RING, _BESIDE = 0.15, (1.25, 1.55)
# Rounds of all frames against all others, Newton's steps in each, and the longest of these, pixels.
_ROUNDS, _STEPS, _MOST_STEP = 2, 4, 0.5
# The bundle moves where following it gives the mean of the frames at least so many times the power about the ring.
# Where it rests, an object of bright points gives up to 1.013 in 12 frames, and more in few, because these average over
# less of it; a bundle that moves by a twentieth of a pitch, halfway through the burst, gives 1.02. Before cells on a
# dark ground frames show different cores, are less alike, and following the cells gains more in the same measure.
_LEAST_GAIN, _LEAST_GAIN_OF_FRAMES = 1.02, 0.3
# The power of the ring in that mean, in parts of the power beside it: bundles have over 10. An object that was
# followed, because the bundle is too faint beside it, has 1.2, and cells or beads on a dark ground up to 7.4.
_LEAST_RING = 8.0
# A frame that agrees with the others less than this part of the median frame does not show the bundle.
_LEAST_OF_USUAL = 0.3
# Pixels: a part of a pixel below which interpolation changes nothing; and frames without more that are enough.
_LEAST_PART, _FEWEST_FRAMES = 0.05, 4
# Pixels: bundles that lie no farther apart than this are in one place.
_SAME_PLACE = 0.2
# Frames are interpolated by a spline of this order.
_SPLINE_ORDER: Final = 3


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """Where the bundle is on the camera.

    Attributes
    ----------
    offsets : numpy.ndarray
        (T, 2) float64, (x, y) in pixels: how far it is in each frame from where it is in one of them.
    """

    offsets: NDArray[np.float64]

    def seen(self, samples: Samples) -> Samples:
        """Return samples of steadied frames without those that lie, all or in part, beyond the frame as recorded."""
        height, width = samples.shape
        offsets = torch.from_numpy(self.offsets).to(samples.positions)[:, None]
        margin = samples.radius or 0.0
        last = torch.tensor([width - 0.5, height - 0.5]).to(offsets) - margin
        first = margin - 0.5
        places = samples.positions + offsets
        # On the side from which the bundle has come, nothing is missing.
        is_seen = ((places > first) | (offsets >= 0)) & ((places < last) | (offsets <= 0))
        return replace(samples, weights=samples.weights * is_seen.all(dim=2))

    @property
    def exact(self) -> NDArray[np.bool_]:
        """(T,), frames that are as good as not interpolated; all where these are too few to measure anything by."""
        parts = np.abs(self.offsets - self.offsets.round()).max(axis=1)
        near: NDArray[np.bool_] = parts < _LEAST_PART
        return near if near.sum() >= _FEWEST_FRAMES else np.ones_like(near)

    @property
    def places(self) -> NDArray[np.intp]:
        """(T,), the number of the place in which each frame has the bundle, from 0."""
        if len(self.offsets) < 2:
            return np.zeros(len(self.offsets), dtype=np.intp)
        number: NDArray[np.intp] = fcluster(linkage(self.offsets, "complete"), _SAME_PLACE, "distance").astype(np.intp)
        return number - 1

    def relative_to(self, frame: int) -> "Mount":
        """Return the same, from where the bundle is in another frame."""
        return Mount(self.offsets - self.offsets[frame])

    def steadied(self, frames: Tensor) -> Tensor:
        """Return frames (T, H, W, C) with the bundle at rest; beyond a frame's edge, what the edge has goes on."""
        moved = [_at_rest(frame, x, y) for frame, (x, y) in zip(frames, self.offsets.tolist(), strict=True)]
        return torch.stack(moved)

    @property
    def note(self) -> str:
        """What a user should know."""
        farthest = float(np.hypot(*(self.offsets - self.offsets.mean(axis=0)).T).max())
        return f"the bundle moves on the camera, by up to {farthest:.1f} px from its mean position; frames follow it"


def find_mount(grey: Tensor) -> Mount | None:
    """Find where the bundle is in each frame, or None where it rests or no bundle is seen.

    Parameters
    ----------
    grey : Tensor
        (T, H, W) in [0, 1]. In frames that do not show the bundle it is taken to be where it was before.
    """
    used = np.flatnonzero(exposed(grey).cpu().numpy())
    pitch = _pitch(grey[used])
    if pitch is None or len(used) < 2:
        return None
    patterns = _Patterns.of(_middle(grey)[used], pitch)
    offsets = torch.zeros(len(used), 2).to(grey)
    mean = patterns.spectra[0]
    for number in range(1, len(used)):
        offsets[number] = patterns.searched(number, mean)
        mean = mean + patterns.moved_back(offsets[number : number + 1], number)[0]
    for _ in range(_ROUNDS):
        offsets = patterns.refined(patterns.others(offsets), offsets)
    power = patterns.power(offsets)
    gain, alike = power / patterns.power(torch.zeros_like(offsets)), power / (len(used) * (len(used) - 1))
    least = max(_LEAST_GAIN, 1 + _LEAST_GAIN_OF_FRAMES / len(used) / max(alike, 1e-9))
    if gain < least or patterns.ring(offsets) < _LEAST_RING:
        return None
    agreement = steady.complex_product(patterns.moved_back(offsets), patterns.others(offsets).conj()).real.sum(dim=1)
    shows = agreement > _LEAST_OF_USUAL * agreement.median()
    used, offsets = used[shows.cpu().numpy()], offsets[shows]
    before = np.searchsorted(used, np.arange(len(grey)), side="right") - 1
    found = (offsets - offsets[0]).cpu().numpy().astype(np.float64)
    return Mount(found[before.clip(0)])


@dataclass(frozen=True, slots=True, eq=False)
class _Patterns:
    """What frames show of the honeycomb, as K frequencies about the lattice's ring.

    Attributes
    ----------
    spectra : Tensor
        (T, K) complex, of the same power for all frames.
    frequencies : Tensor
        (K, 2) along x and y, radians per pixel.
    band : Tensor
        (H, W // 2 + 1) bool, which of all frequencies these are.
    shape : (int, int)
        Of the images that the spectra are of.
    ring_frequency : float
        Cycles per pixel.
    """

    spectra: Tensor
    frequencies: Tensor
    band: Tensor
    shape: tuple[int, int]
    ring_frequency: float

    @classmethod
    def of(cls, images: Tensor, pitch: float) -> "_Patterns":
        """Take the honeycomb out of images (T, H, W)."""
        height, width = images.shape[1:]
        y, x = torch.meshgrid(
            torch.fft.fftfreq(height, device=images.device),
            torch.fft.rfftfreq(width, device=images.device),
            indexing="ij",
        )
        frequency = torch.hypot(x, y) / ring_frequency(pitch)
        band = (frequency > _BAND[0]) & (frequency < _BAND[1])
        rows, columns = (torch.hann_window(side, periodic=False).to(images) for side in (height, width))
        soft, mass = rows[:, None] * columns, blur(torch.ones_like(images[0]), _ENVELOPE * pitch).clamp_min(1e-4)
        floor = _LEAST_LIGHT * steady.mean(images)
        spectra = torch.stack([torch.fft.rfft2(soft * _flat(image, mass, floor, pitch))[band] for image in images])
        spectra = spectra / spectra.norm(dim=1, keepdim=True).clamp_min(1e-9)
        frequencies = 2 * math.pi * torch.stack([x[band], y[band]], dim=1)
        return cls(spectra, frequencies, band, (height, width), ring_frequency(pitch))

    def moved_back(self, offsets: Tensor, first: int = 0) -> Tensor:
        """Return the spectra of images from the first on, whose bundles were `offsets` away, moved to where that is 0.

        Offsets are (n, 2), and spectra (n, K).
        """
        return steady.complex_product(self.spectra[first : first + len(offsets)], self._waves(offsets))

    def others(self, offsets: Tensor) -> Tensor:
        """Return for each image the sum of all others, moved back."""
        moved = self.moved_back(offsets)
        return moved.sum(dim=0) - moved

    def power(self, offsets: Tensor) -> float:
        """Return the power that the mean of the images moved back has beyond what unlike images leave of themselves."""
        together = self.moved_back(offsets).sum(dim=0)
        return float(steady.total(together.abs().square()) - steady.total(self.spectra.abs().square()))

    def ring(self, offsets: Tensor) -> float:
        """Return how far the ring stands out of the mean of the images moved back, in parts of the power beside it."""
        power = self.moved_back(offsets).sum(dim=0).abs().square()
        distance = self.frequencies.norm(dim=1) / (2 * math.pi * self.ring_frequency)
        near, beside = (distance - 1).abs() < _RING, (distance > _BESIDE[0]) & (distance < _BESIDE[1])
        return float(steady.mean(power[near]) / steady.mean(power[beside]))

    def searched(self, number: int, mean: Tensor) -> Tensor:
        """Return where a frame's bundle is relative to that of a mean spectrum (K,), (2,)."""
        product = steady.complex_product(self.spectra[number], mean.conj())
        # Half a pixel apart, because where cores are three pixels apart, the peak is narrower than a pixel.
        between = torch.tensor([[x, y] for y in (0.0, 0.5) for x in (0.0, 0.5)]).to(self.frequencies)
        spectra = torch.zeros(len(between), *self.band.shape, dtype=mean.dtype, device=mean.device)
        spectra[:, self.band] = steady.complex_product(product, self._waves(between))
        correlations = steady.irfft2(spectra, self.shape).roll((MOST_OFFSET, MOST_OFFSET), (1, 2))
        near = correlations[:, : 2 * MOST_OFFSET + 1, : 2 * MOST_OFFSET + 1]
        which, row, column = np.unravel_index(int(near.argmax()), near.shape)
        start = between[which] + torch.tensor([column - MOST_OFFSET, row - MOST_OFFSET]).to(between)
        return self._climbed(product[None], start[None])[0]

    def refined(self, means: Tensor, offsets: Tensor) -> Tensor:
        """Return where the frames' bundles are relative to those of mean spectra (T, K), near `offsets` (T, 2)."""
        return self._climbed(steady.complex_product(self.spectra, means.conj()), offsets)

    def _waves(self, offsets: Tensor) -> Tensor:
        """Return what moves spectra by offsets (T, 2): (T, K), of absolute value 1."""
        # A product of matrices is rounded as threads divide it.
        phase = offsets[:, :1] * self.frequencies[:, 0] + offsets[:, 1:] * self.frequencies[:, 1]
        return torch.polar(torch.ones_like(phase), phase)

    def _climbed(self, products: Tensor, offsets: Tensor) -> Tensor:
        """Climb correlations, of which (T, K) are the spectra, by Newton's steps from `offsets` (T, 2)."""
        x, y = self.frequencies.T
        first, second = torch.stack([x, y]), torch.stack([x * x, x * y, x * y, y * y])
        for _ in range(_STEPS):
            waves = steady.complex_product(products, self._waves(offsets))
            slope = -steady.row_sums(waves.imag[:, None] * first)
            curvature = steady.row_sums(waves.real[:, None] * second).reshape(-1, 2, 2)
            # Beside a peak there may be none in reach: then it is better to stay.
            is_peak = (torch.linalg.det(curvature) > 0) & (curvature[:, 0, 0] > 0)
            safe = torch.where(is_peak[:, None, None], curvature, torch.eye(2).to(curvature))
            step = torch.linalg.solve(safe, slope).clamp(-_MOST_STEP, _MOST_STEP)
            offsets = offsets + step * is_peak[:, None]
        return offsets


def _flat(image: Tensor, mass: Tensor, floor: Tensor, pitch: float) -> Tensor:
    """Return what an image (H, W) has beside its slow changes, relative to these; bright spots count for little."""
    flat = image / (blur(image, _ENVELOPE * pitch) / mass + floor).clamp_min(1e-9) - 1
    most = _MOST_OF_USUAL * flat.abs().median()
    return flat.clamp(-most, most)


def _at_rest(frame: Tensor, x: float, y: float) -> Tensor:
    """Return a frame (H, W, C) moved back by an offset."""
    if not (x or y):
        return frame
    pixels: NDArray[np.float32] = frame.cpu().numpy()
    moved = [shift(band, (-y, -x), order=_SPLINE_ORDER, mode="nearest") for band in np.moveaxis(pixels, 2, 0)]
    return torch.from_numpy(np.stack(moved, axis=2)).to(frame).clamp(0, 1)


def _pitch(grey: Tensor) -> float | None:
    """Return the pitch as single frames show it, because their mean may not show a bundle that moves."""
    some = np.unique(np.linspace(0, len(grey) - 1, _PITCH_FRAMES).astype(int))
    found = [pitch for pitch in map(find_pitch, _middle(grey[some])) if pitch is not None]
    return float(np.median(found)) if len(found) > len(some) / 2 else None


def _middle(grey: Tensor) -> Tensor:
    """Return the middle of images (T, H, W)."""
    top, left = ((side - _MOST_SIDE) // 2 if side > _MOST_SIDE else 0 for side in grey.shape[1:])
    return grey[:, top : top + _MOST_SIDE, left : left + _MOST_SIDE]
