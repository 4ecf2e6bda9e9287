"""What the sensors of a burst have seen: one value per core, or per lit pixel, and frame.

In a real bundle there is no detail inside a core: each gathers the light of its footprint and re-emits one value
through its profile, so one value per core and frame is all there is, and the footprint is part of the model. Where the
pictures do show detail inside cores (a bundle that merely masks the scene), every lit pixel is a sensor of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from napari_fiberburst.bundle.calibrate import Calibration

# Pixels that pass less than this part of a bright core's light say little.
_LEAST_TRANSMISSION = 0.2
# From this intensity on a pixel is taken as saturated.
SATURATED = 0.998
# Part of the detail predicted inside cores that must be there to count as real.
_LEAST_DETAIL = 0.4
_DETAIL_SAMPLES = 300_000
_LEAST_DETAIL_FRAMES = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observation:
    """Samples of the scene by N sensors in T frames.

    Attributes
    ----------
    kind : str
        "cores" or "pixels".
    positions : Tensor
        (N, 2), where the sensors are, frame pixels.
    values : Tensor
        (T, N, C), the light of the scene at each sensor, as a bright core would show it, 0 to 1.
    weights : Tensor
        (T, N), how much each sample counts, 1 for a typical one; 0 where there is none.
    sources : Tensor
        (N,) int64, the core that each sensor belongs to.
    radius : float or None
        Of the sensors' footprint, pixels; None for points.
    """

    kind: Literal["cores", "pixels"]
    positions: Tensor
    values: Tensor
    weights: Tensor
    sources: Tensor
    radius: float | None

    def with_gains(self, gains: Tensor) -> "Observation":
        """Return the observation with each core's gain (G,) or (G, C) taken out of its values."""
        own = gains[self.sources]
        if own.ndim == 1:
            return replace(self, values=self.values / own[:, None], weights=self.weights * own**2)
        return replace(self, values=self.values / own, weights=self.weights * own.mean(dim=1) ** 2)

    def weighted(self, frames: Tensor) -> "Observation":
        """Return the observation with each frame's weights multiplied by that frame's in `frames`, (T,)."""
        return replace(self, weights=self.weights * frames.to(self.weights)[:, None])


def observe_cores(frames: Tensor, calibration: Calibration) -> Observation:
    """Reduce frames (T, H, W, C) to one value per core: the least-squares amplitude of its profile.

    Saturated pixels are left out of it.
    """
    count, channels = len(calibration.centres), frames.shape[-1]
    own = calibration.labels < count
    labels, profile = calibration.labels[own], calibration.transmission[own]
    values = torch.zeros(len(frames), count, channels).to(frames)
    power = torch.zeros(len(frames), count).to(frames)
    for number, frame in enumerate(frames):
        light = frame[own]
        usable = profile * (light.amax(dim=1) < SATURATED)
        values[number].index_add_(0, labels, (light - calibration.black) * usable[:, None])
        power[number].index_add_(0, labels, usable * profile)
    typical = power[power > 0].median() if (power > 0).any() else power.new_tensor(1.0)
    weights = (power / typical).clamp(max=3)
    enough = weights > 0.02
    return Observation(
        kind="cores",
        positions=calibration.centres,
        values=torch.where(enough[..., None], values / power.clamp_min(1e-9)[..., None], torch.zeros_like(values)),
        weights=weights * enough,
        sources=torch.arange(count, device=frames.device),
        radius=calibration.radius,
    )


def observe_pixels(frames: Tensor, calibration: Calibration) -> Observation:
    """Take every lit pixel of frames (T, H, W, C) as a sensor that sees one point of the scene."""
    lit = (calibration.labels < len(calibration.centres)) & (calibration.transmission > _LEAST_TRANSMISSION)
    passed = calibration.transmission[lit]
    light = frames[:, lit]
    weights = passed**2 * (light.amax(dim=2) < SATURATED)
    return Observation(
        kind="pixels",
        positions=lit.nonzero().flip(1).to(frames.dtype),
        values=(light - calibration.black) / passed[:, None],
        weights=weights,
        sources=calibration.labels[lit],
        radius=None,
    )


def shows_detail(
    frames: Tensor, calibration: Calibration, cores: Observation, predicted: Callable[[int, Tensor], Tensor]
) -> bool:
    """Whether the frames show detail inside cores, rather than one value per core.

    The aligned scene, which knows a core's surroundings from other frames, predicts how light should vary inside the
    core, relative to its mean. Where there is detail, what pixels show follows that prediction as it changes from frame
    to frame; behind real fibres it does not. What stands still is left out of the comparison, for the transmission,
    measured with that same prediction, shares it.

    Parameters
    ----------
    frames : Tensor
        (T, H, W) grey intensities.
    calibration : Calibration
        With a transmission that was measured after alignment.
    cores : Observation
        Of the same frames, grey.
    predicted : callable
        As for `napari_fiberburst.bundle.calibrate.remeasure`.
    """
    lit = (calibration.labels < len(calibration.centres)) & (calibration.transmission > 0.5)
    pixels = lit.nonzero().flip(1).to(frames.dtype)
    labels, passed = calibration.labels[lit], calibration.transmission[lit]
    count = len(calibration.centres)
    area = torch.zeros(count).to(frames).index_add_(0, labels, passed**2).clamp_min(1e-9)
    sums = torch.zeros(5, len(pixels)).to(frames)
    needed = max(_LEAST_DETAIL_FRAMES, -(-_DETAIL_SAMPLES // len(pixels)))
    for number in range(0, len(frames), max(1, len(frames) // needed)):
        seen = predicted(number, pixels)
        mean = torch.zeros(count).to(frames).index_add_(0, labels, passed**2 * seen) / area
        core = cores.values[number, labels].mean(dim=-1)
        known = (seen > 0) & (cores.weights[number, labels] > 0) & (core > 0) & (mean[labels] > 0)
        weight = passed**2 * core.square() * known
        expected = torch.where(known, seen / mean[labels].clamp_min(1e-6) - 1, torch.zeros_like(seen))
        light = (frames[number][lit] - calibration.black) / passed
        shown = torch.where(known, light / core.clamp_min(1e-6) - 1, torch.zeros_like(seen))
        sums += weight * torch.stack([torch.ones_like(seen), expected, shown, expected * shown, expected * expected])
    mass, expected, shown, both, square = sums
    mass = mass.clamp_min(1e-9)
    agreement = float((both - expected * shown / mass).sum())
    power = float((square - expected * expected / mass).sum())
    return power > 0 and agreement / power > _LEAST_DETAIL
