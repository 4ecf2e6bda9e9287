"""What is left to learn of the bundle's gains once the scene is solved in colour."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.scene.prediction import predict

# A core's gain in a channel is asked for where it has seen at least this part of the light that the median core has.
_LEAST_LIGHT_OF_USUAL = 0.05
# A pixel's share of its core's light is asked for where it has seen at least this part of the mean light.
_LEAST_LIGHT_OF_MEAN = 1e-3
# Gains beyond these are not believed.
_LEAST_CHANNEL_GAIN, _MOST_CHANNEL_GAIN = 0.2, 5.0
_LEAST_SHARE, _MOST_SHARE = 0.1, 10.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GainChange:
    """How gains differ from what samples assumed.

    Attributes
    ----------
    shares : Tensor or None
        (N,) each pixel's gain relative to that of its core; None where samples are cores, or shares are known.
    channels : Tensor or None
        (G, C) each core's gain in each channel relative to its gain in all of them; None for one channel.
    """

    shares: Tensor | None = None
    channels: Tensor | None = None

    def taken_out_of(self, samples: Samples) -> Samples:
        """Return samples without these gains."""
        if self.shares is not None:
            weights = samples.weights * self.shares**2
            samples = replace(samples, values=samples.values / self.shares[:, None], weights=weights)
        return samples if self.channels is None else samples.without_gains(self.channels)


def refine_gains(samples: Samples, points: Tensor, grid: Grid, filtered: Tensor) -> tuple[Samples, GainChange]:
    """Take finer gains out of samples, by the scene that other samples agree on.

    Where pixels are samples, each one's share of its core's light is measured. Where there are several channels, each
    core's gain in each is, as far as its difference from the other channels stands out of the noise. What all pixels
    and channels of a core have in common stays as it is: if it moved in turn with the scene, the smoothness prior would
    push brightness from the scene into the gains.

    Parameters
    ----------
    samples : Samples
        As they are.
    points : Tensor
        (T, N, 2), where they lie in the scene.
    grid : Grid
        Of the scene.
    filtered : Tensor
        (C, H, W), the scene as samples see it through their footprint.

    Returns
    -------
    Samples, GainChange
        Without those gains, and the gains.
    """
    agreement, power, left = _compare(samples, points, grid, filtered)
    shares = None
    if samples.kind == "pixels" and not samples.gains_known:
        shares = _shares(agreement.sum(dim=1), power.sum(dim=1), samples.core_index)
        samples = GainChange(shares=shares).taken_out_of(samples)
        agreement = agreement / shares[:, None]
    if samples.values.shape[2] == 1:
        return samples, GainChange(shares=shares)
    agreement, power = (_per_core(part, samples) for part in (agreement, power))
    gains = agreement / power.clamp_min(1e-9)
    common = (agreement.sum(dim=1) / power.sum(dim=1).clamp_min(1e-9)).clamp_min(1e-6)
    known = power.amin(dim=1) > _LEAST_LIGHT_OF_USUAL * power.median()
    if not known.any():
        return samples, GainChange(shares=shares)
    deviation = gains / common[:, None] - 1
    deviation = deviation - deviation[known].median(dim=0).values
    # Shrunk towards no difference, as the noise makes part of the variance (Wiener).
    noise = left / power.clamp_min(1e-9)
    variance = (steady.mean(deviation[known].square()) - steady.mean(noise[known])).clamp_min(0)
    shrunk = deviation * variance / (variance + noise).clamp_min(1e-12)
    channels = (1 + torch.where(known[:, None], shrunk, torch.zeros_like(shrunk))).clamp(
        _LEAST_CHANNEL_GAIN, _MOST_CHANNEL_GAIN
    )
    return GainChange(channels=channels).taken_out_of(samples), GainChange(shares=shares, channels=channels)


def measured_gains(samples: Samples, points: Tensor, grid: Grid, filtered: Tensor) -> tuple[Tensor, Tensor]:
    """Return each core's gain relative to what samples assume, (G,), and how much light that rests on, (G,).

    The least-squares gain of all samples of a core against the scene. The light is the sum of squares of what the scene
    shows to the core, full scale 1, over frames and averaged over channels; a core of weight 1 that sees full light
    in one frame counts 1.
    """
    agreement, power, _ = _compare(samples, points, grid, filtered)
    agreement, power = (_per_core(part, samples).mean(dim=1) for part in (agreement, power))
    known = power > 0
    return torch.where(known, agreement / power.clamp_min(1e-12), torch.ones_like(power)), power


def _compare(samples: Samples, points: Tensor, grid: Grid, filtered: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return, over the frames, the sums of v s and of s^2 (N, C), and the mean of (v - s)^2."""
    agreement = torch.zeros_like(samples.values[0])
    power = torch.zeros_like(agreement)
    left = mass = torch.zeros(()).to(agreement)
    for _, values, light, weights in predict(samples, points, grid, filtered):
        weight = weights[:, None]
        agreement += weight * values * light
        power += weight * light**2
        left = left + steady.total(weight * (values - light) ** 2)
        mass = mass + steady.total(weight) * light.shape[1]
    return agreement, power, left / mass.clamp_min(1e-9)


def _shares(agreement: Tensor, power: Tensor, core_index: Tensor) -> Tensor:
    """Return each pixel's gain relative to its core's, (N,)."""
    enough = power > _LEAST_LIGHT_OF_MEAN * steady.mean(power)
    gain = torch.where(enough, agreement / power.clamp_min(1e-9), torch.ones_like(power))
    gain = gain.clamp(_LEAST_SHARE, _MOST_SHARE)
    total, mass = (
        torch.zeros(int(core_index.max()) + 1).to(gain).index_add_(0, core_index, part)
        for part in (gain * power, power)
    )
    whole = total / mass.clamp_min(1e-9)
    return gain / whole[core_index].clamp_min(1e-3)


def _per_core(values: Tensor, samples: Samples) -> Tensor:
    total = torch.zeros(samples.cores, values.shape[1]).to(values)
    return total.index_add_(0, samples.core_index, values)
