"""Step 3: what the bundle has sampled of the scene, one value per core, or per lit pixel, and frame.

In a real bundle there is no detail inside a core: each gathers the light of its footprint and re-emits one value
through its profile, so one value per core and frame is all there is, and the footprint is part of the model. Where the
images do show detail inside cores (a bundle that merely masks the scene), every lit pixel is a sample of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.bundle import GUESSED_GAINS, Bundle
from napari_fiberburst.data.burst import Acquisition, Burst
from napari_fiberburst.device import find_device
from napari_fiberburst.operators import steady
from napari_fiberburst.stored import Stored

# Pixels that pass less than this part of a bright core's light say little.
_LEAST_TRANSMISSION = 0.2
# From this intensity on, full scale 1, a pixel is taken as saturated.
SATURATED = 0.998
# Frames that vary less than this part of the median frame are black, white or empty in another way.
_LEAST_CONTRAST_OF_USUAL = 0.2
# A frame with at least this part of its pixels over-exposed is white.
_MOST_GLARE = 0.5
# A core counts at most as much as this many typical ones, and not at all below this part of one.
_MOST_WEIGHT, _LEAST_WEIGHT = 3.0, 0.02
# Part of the detail predicted inside cores that must be there to count as real.
_LEAST_DETAIL = 0.4
# So many samples, and frames, are enough to tell.
_DETAIL_SAMPLES = 300_000
_LEAST_DETAIL_FRAMES = 4
# Only pixels that pass at least this part of a bright core's light are asked, of cores with at least this part of the
# mean light.
_LIT, _LEAST_LIT_CORE = 0.5, 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples(Stored):
    """Samples of the scene at N places in T frames. Tensors are on the device of the run.

    Attributes
    ----------
    kind : str
        "cores" or "pixels".
    positions : Tensor
        (N, 2) as (x, y), where the samples are taken, frame pixels.
    values : Tensor
        (T, N, C), the light of the scene at each place, as a bright core would show it, full scale 1.
    weights : Tensor
        (T, N), how much each sample counts, 1 for a typical one; 0 where there is none.
    core_index : Tensor
        (N,) int64, the core that each sample comes through.
    cores : int
        How many cores the bundle has.
    radius : float or None
        Of the footprint of each sample, pixels; None for points.
    shape : (int, int)
        Height and width of a frame, pixels.
    pitch : float
        Distance of neighbouring cores, pixels.
    gain_variance : float
        Of the cores' gains about those that are taken out, as far as it is known before the burst is asked; 0 where
        there are none to be found.
    """

    _kind: ClassVar[str] = "set of samples"

    kind: Literal["cores", "pixels"]
    positions: Tensor
    values: Tensor
    weights: Tensor
    core_index: Tensor
    cores: int
    radius: float | None
    shape: tuple[int, int]
    pitch: float
    gain_variance: float

    @property
    def grey(self) -> Tensor:
        """Values averaged over the channels, (T, N)."""
        return self.values.mean(dim=2)

    @property
    def mean_light(self) -> Tensor:
        """What each place shows on average over the frames, grey, (N,); 0 where nothing has weight."""
        return (self.weights * self.grey).sum(dim=0) / self.weights.sum(dim=0).clamp_min(1e-9)

    @property
    def gains_known(self) -> bool:
        """Whether the gains were measured beforehand, or there are none."""
        return self.gain_variance < GUESSED_GAINS

    @property
    def contrast(self) -> Tensor:
        """Standard deviation of the grey values, by their weights; a scalar."""
        mean = steady.weighted_mean(self.grey, self.weights)
        return steady.weighted_mean((self.grey - mean).square(), self.weights).sqrt()

    def without_gains(self, gains: Tensor) -> "Samples":
        """Return the samples with each core's gain (G,) or (G, C) taken out of their values."""
        own = gains[self.core_index]
        if own.ndim == 1:
            return replace(self, values=self.values / own[:, None], weights=self.weights * own**2)
        return replace(self, values=self.values / own, weights=self.weights * own.mean(dim=1) ** 2)

    def without_exposures(self, exposures: Tensor) -> "Samples":
        """Return the samples with each frame's exposure (T,), or (T, C), taken out of their values."""
        per_channel = exposures if exposures.ndim == 2 else exposures[:, None]
        weights = self.weights * per_channel.mean(dim=1, keepdim=True) ** 2
        return replace(self, values=self.values / per_channel[:, None, :], weights=weights)

    def weighted(self, frames: Tensor) -> "Samples":
        """Return the samples with each frame's weights multiplied by that frame's in `frames`, (T,)."""
        return replace(self, weights=self.weights * frames.to(self.weights)[:, None])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BundleTensors:
    """A bundle on a device, in the intensities of one burst.

    Attributes
    ----------
    own : Tensor
        (H, W) bool, pixels that belong to a core.
    labels : Tensor
        (H, W) int64, the core of each pixel; N where none.
    transmission : Tensor
        (H, W).
    centres : Tensor
        (N, 2).
    gains, offsets : Tensor
        (N, C or 1); offsets with full scale 1.
    black : float
        Full scale 1.
    """

    own: Tensor
    labels: Tensor
    transmission: Tensor
    centres: Tensor
    gains: Tensor
    offsets: Tensor
    black: float

    @classmethod
    def of(cls, bundle: Bundle, acquisition: Acquisition, device: torch.device) -> "BundleTensors":
        """Bring a bundle to a device."""
        span = acquisition.white_level - acquisition.black_level
        labels = torch.from_numpy(bundle.labels).to(device).long()
        return cls(
            own=labels < len(bundle.centres),
            labels=labels,
            transmission=torch.from_numpy(bundle.transmission).to(device),
            centres=torch.from_numpy(bundle.centres).float().to(device),
            gains=torch.from_numpy(bundle.gains).to(device),
            offsets=torch.from_numpy(bundle.offsets).to(device) / span,
            black=bundle.black_in(acquisition),
        )

    def per_channel(self, values: Tensor, channels: int) -> Tensor:
        """Return gains or offsets (N, C or 1) for frames of so many channels; their mean where the number differs."""
        return values if values.shape[1] in (1, channels) else values.mean(dim=1, keepdim=True)


def in_grey(frames: Tensor) -> Tensor:
    """Return frames (..., C) averaged over channels, (...), several times as fast as torch does over a last axis."""
    first, *others = frames.unbind(dim=-1)
    if not others:
        return first
    total: Tensor = sum(others, first)
    return total / frames.shape[-1]


def contrast_and_glare(frames: Tensor) -> tuple[Tensor, Tensor]:
    """Return the standard deviation of each frame (T, H, W), (T,), and the part of it that is over-exposed, (T,)."""
    # One by one, because what this makes of a frame is as large as it is.
    contrast = torch.stack([steady.mean((frame - steady.mean(frame)).square()).sqrt() for frame in frames])
    return contrast, torch.stack([(frame >= SATURATED).sum() / frame.numel() for frame in frames])


def shows_something(contrast: Tensor, glare: Tensor) -> Tensor:
    """Return which frames are not black, white or even (T,), by `contrast_and_glare` of all of them."""
    return (contrast > _LEAST_CONTRAST_OF_USUAL * contrast.median()) & (glare < _MOST_GLARE)


def exposed(frames: Tensor) -> Tensor:
    """Return which frames (T, H, W) show something: not all black, white or even; all of them where none does."""
    good = shows_something(*contrast_and_glare(frames))
    return good if bool(good.any()) else torch.ones_like(good)


def only_exposed(frames: Tensor) -> Tensor:
    """Return those of frames (T, H, W) that show something."""
    good = exposed(frames)
    return frames if bool(good.all()) else frames[good]


def sample(
    burst: Burst, bundle: Bundle, kind: Literal["cores", "pixels"] = "cores", *, device: str = "auto"
) -> Samples:
    """Take what the bundle has sampled of the scene out of a burst's frames.

    Parameters
    ----------
    burst : Burst
        The frames.
    bundle : Bundle
        Of the same size, at the place where it is in these frames.
    kind : str
        "cores": one value a core, the least-squares amplitude of its profile. "pixels": every lit pixel, divided by its
        transmission.
    device : str
        Where to compute.

    Returns
    -------
    Samples
        With all frames in it, those without weight that are black, white or even; `register` finds others that do not
        belong.
    """
    frames = torch.from_numpy(burst.frames).to(find_device(device))
    return (sample_pixels if kind == "pixels" else sample_cores)(frames, bundle, burst)


def sample_cores(frames: Tensor, bundle: Bundle, acquisition: Acquisition) -> Samples:
    """Reduce frames (T, H, W, C) to one value a core: the least-squares amplitude of its profile.

    Saturated pixels are left out of it, and so are frames that show nothing.
    """
    known = BundleTensors.of(bundle, acquisition, frames.device)
    count, channels = len(known.centres), frames.shape[-1]
    own = known.own.flatten().nonzero()[:, 0]
    labels, profile = known.labels.flatten()[own], known.transmission.flatten()[own]
    values = torch.zeros(len(frames), count, channels).to(frames)
    power = torch.zeros(len(frames), count).to(frames)
    for number in exposed(in_grey(frames)).nonzero()[:, 0].tolist():
        light = frames[number].flatten(0, 1).index_select(0, own)
        usable = profile * (light.amax(dim=1) < SATURATED)
        values[number].index_add_(0, labels, (light - known.black) * usable[:, None])
        power[number].index_add_(0, labels, usable * profile)
    typical = power[power > 0].median() if (power > 0).any() else power.new_tensor(1.0)
    weights = (power / typical).clamp(max=_MOST_WEIGHT)
    enough = weights > _LEAST_WEIGHT
    values = torch.where(enough[..., None], values / power.clamp_min(1e-9)[..., None], torch.zeros_like(values))
    gains, offsets = (known.per_channel(part, channels) for part in (known.gains, known.offsets))
    return Samples(
        kind="cores",
        positions=known.centres,
        values=(values - offsets) / gains,
        weights=weights * enough,
        core_index=torch.arange(count, device=frames.device),
        cores=count,
        radius=bundle.radius,
        shape=bundle.shape,
        pitch=bundle.pitch,
        gain_variance=bundle.gain_variance,
    )


def lit_pixels(bundle: Bundle) -> NDArray[np.bool_]:
    """Return which pixels of a frame (H, W) are samples where pixels are."""
    lit: NDArray[np.bool_] = (bundle.labels < len(bundle.centres)) & (bundle.transmission > _LEAST_TRANSMISSION)
    return lit


def sample_pixels(frames: Tensor, bundle: Bundle, acquisition: Acquisition) -> Samples:
    """Take every lit pixel of frames (T, H, W, C) as a sample of one point of the scene.

    Saturated pixels have no weight, nor have frames that show nothing.
    """
    known = BundleTensors.of(bundle, acquisition, frames.device)
    lit = torch.from_numpy(lit_pixels(bundle)).to(frames.device)
    passed, labels = known.transmission[lit], known.labels[lit]
    light = frames[:, lit]
    gains, offsets = (known.per_channel(part, frames.shape[-1])[labels] for part in (known.gains, known.offsets))
    return Samples(
        kind="pixels",
        positions=lit.nonzero().flip(1).to(frames.dtype),
        values=((light - known.black) / passed[:, None] - offsets) / gains,
        weights=passed**2 * ((light.amax(dim=2) < SATURATED) & exposed(in_grey(frames))[:, None]),
        core_index=labels,
        cores=len(known.centres),
        radius=None,
        shape=bundle.shape,
        pitch=bundle.pitch,
        gain_variance=bundle.gain_variance,
    )


def shows_detail(
    grey: Tensor, bundle: Bundle, acquisition: Acquisition, cores: Samples, predicted: Callable[[int, Tensor], Tensor]
) -> bool:
    """Whether the frames show detail inside cores, rather than one value a core.

    The registered scene, which knows a core's surroundings from other frames, predicts how light should vary inside the
    core, relative to its mean. Where there is detail, what pixels show follows that prediction as it changes from frame
    to frame; behind real fibres it does not. Only changes from frame to frame are compared, because what stands still
    is in the transmission too, which was measured with that same prediction.

    Parameters
    ----------
    grey : Tensor
        (T, H, W) intensities in [0, 1].
    bundle : Bundle
        With a transmission that was measured after registration.
    acquisition : Acquisition
        Of the burst.
    cores : Samples
        Of the same frames, grey.
    predicted : callable
        As for `napari_fiberburst.bundle.transmission.remeasure`.
    """
    known = BundleTensors.of(bundle, acquisition, grey.device)
    lit = known.own & (known.transmission > _LIT)
    pixels = lit.nonzero().flip(1).to(grey.dtype)
    labels, passed = known.labels[lit], known.transmission[lit]
    count = len(known.centres)
    area = torch.zeros(count).to(grey).index_add_(0, labels, passed**2).clamp_min(1e-9)
    moments = torch.zeros(5, len(pixels)).to(grey)
    needed = max(_LEAST_DETAIL_FRAMES, -(-_DETAIL_SAMPLES // max(1, len(pixels))))
    for number in range(0, len(grey), max(1, len(grey) // needed)):
        scene = predicted(number, pixels)
        mean = torch.zeros(count).to(grey).index_add_(0, labels, passed**2 * scene) / area
        core = cores.values[number, labels].mean(dim=-1)
        # Of a core in the dark nothing can be said in parts of its light.
        floor = _LEAST_LIT_CORE * steady.mean(mean)
        usable = (scene > 0) & (cores.weights[number, labels] > 0) & (core > floor) & (mean[labels] > floor)
        weight = passed**2 * core.square() * usable
        expected = torch.where(usable, scene / mean[labels].clamp_min(1e-6) - 1, torch.zeros_like(scene))
        light = (grey[number][lit] - known.black) / passed
        shown = torch.where(usable, light / core.clamp_min(1e-6) - 1, torch.zeros_like(scene))
        terms = [torch.ones_like(scene), expected, shown, expected * shown, expected * expected]
        moments += weight * torch.stack(terms)
    mass, expected, shown, both, square = moments
    mass = mass.clamp_min(1e-9)
    agreement = float(steady.total(both - expected * shown / mass))
    power = float(steady.total(square - expected * expected / mass))
    return power > 0 and agreement / power > _LEAST_DETAIL
