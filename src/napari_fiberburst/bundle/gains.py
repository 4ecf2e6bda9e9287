"""What is left to learn of the gains once the scene is solved in colour."""

from dataclasses import replace

import torch
from torch import Tensor

from napari_fiberburst.bundle.samples import Observation
from napari_fiberburst.operators.grid import Grid


def refreshed(
    seen: Observation, points: Tensor, grid: Grid, through: Tensor, *, shares_known: bool = False
) -> Observation:
    """Return the observation with finer gains taken out of it.

    Where pixels are sensors, each one's part of its core's light is measured anew. Where there are several channels,
    each core's gain in each is, as far as its difference from the other channels stands out of the noise. What all
    pixels and channels of a core have in common stays as it is: moving it in turn with the scene would let the
    smoothness prior push brightness from the scene into the gains.

    Parameters
    ----------
    seen : Observation
        As it is.
    points : Tensor
        (T, N, 2), where its sensors are in the scene.
    grid : Grid
        Of the scene.
    through : Tensor
        (C, H, W), the scene as sensors see it.
    shares_known : bool
        Leave each pixel's part of its core's light as it is.
    """
    agreement, power, left = _compare(seen, points, grid, through)
    values = seen.values
    if seen.kind == "pixels" and not shares_known:
        share = _share(agreement.sum(dim=1), power.sum(dim=1), seen.sources)
        seen = replace(seen, values=values / share[:, None], weights=seen.weights * share**2)
        agreement = agreement / share[:, None]
    if values.shape[2] == 1:
        return seen
    per_core, power_per_core = (_per_core(part, seen.sources) for part in (agreement, power))
    gains = per_core / power_per_core.clamp_min(1e-9)
    common = (per_core.sum(dim=1) / power_per_core.sum(dim=1).clamp_min(1e-9)).clamp_min(1e-6)
    known = power_per_core.amin(dim=1) > 0.05 * power_per_core.median()
    deviation = gains / common[:, None] - 1
    deviation = deviation - deviation[known].median(dim=0).values if known.any() else deviation * 0
    noise = left / power_per_core.clamp_min(1e-9)
    spread = (
        (deviation[known].square().mean() - noise[known].mean()).clamp_min(0) if known.any() else deviation.sum() * 0
    )
    trusted = torch.where(known[:, None], deviation * spread / (spread + noise).clamp_min(1e-12), deviation * 0)
    return seen.with_gains((1 + trusted).clamp(0.2, 5))


def _compare(seen: Observation, points: Tensor, grid: Grid, through: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return, over the frames, the sums of v s and of s^2 (N, C), and the mean of (v - s)^2."""
    agreement = torch.zeros_like(seen.values[0])
    power = torch.zeros_like(agreement)
    left = mass = torch.zeros(()).to(agreement)
    for number, weights in enumerate(seen.weights):
        if not bool((weights > 0).any()):
            continue
        at = grid.at(points[number])
        light = torch.stack([at.read(channel) for channel in through], dim=1)
        weight = (weights * at.inside)[:, None]
        agreement += weight * seen.values[number] * light
        power += weight * light**2
        left = left + (weight * (seen.values[number] - light) ** 2).sum()
        mass = mass + weight.sum() * light.shape[1]
    return agreement, power, left / mass.clamp_min(1e-9)


def _share(agreement: Tensor, power: Tensor, sources: Tensor) -> Tensor:
    """Return each pixel's gain relative to its core's, (N,)."""
    gain = torch.where(power > 1e-3 * power.mean(), agreement / power.clamp_min(1e-9), torch.ones_like(power))
    gain = gain.clamp(0.1, 10)
    whole = _per_core((gain * power)[:, None], sources) / _per_core(power[:, None], sources).clamp_min(1e-9)
    return gain / whole[sources, 0].clamp_min(1e-3)


def _per_core(values: Tensor, sources: Tensor) -> Tensor:
    total = torch.zeros(int(sources.max()) + 1, values.shape[1]).to(values)
    return total.index_add_(0, sources, values)
