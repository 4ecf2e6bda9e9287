"""How far gains that are given are believed: as far as the burst bears them out."""

from dataclasses import replace

import torch
from torch import Tensor

from napari_fiberburst.motion.linearised import huber
from napari_fiberburst.motion.problem import JointProblem, JointState
from napari_fiberburst.operators import steady

# Gains farther from those given than so many times their median distance count as if they were there.
_FAR = 6.0
# Variance of the gains about those given, at least.
_LEAST_VARIANCE = 1e-8


def with_told_prior(problem: JointProblem, state: JointState) -> JointProblem:
    """Return the problem with the prior variance of its gains as the burst tells it.

    Each half of the frames tells every core's gain by itself. What the two halves agree on is the given gains' error,
    and what they do not agree on is the error of what they tell, which is more than the samples' noise makes: no model
    is exact (empirical Bayes; Efron and Morris, 1973). The prior is so strong that gains go as far from those given as
    the first is a part of both.

    Parameters
    ----------
    problem : JointProblem
        Whose gains are known beforehand, with a variance.
    state : JointState
        Scene and motion, as they are.
    """
    light = state.exposures[:, None] * (sampling := state.grid.at(problem.points(state.motion)))(state.filtered)
    weights = problem.weights * sampling.inside
    residual = problem.values - state.gains[problem.core_index] * light
    weights = weights * huber(residual, weights)
    used = (weights > 0).any(dim=1).nonzero()[:, 0]
    halves = [_told(problem, light, weights, used[first::2]) for first in (0, 1)]
    power = halves[0][1] + halves[1][1]
    mass = halves[0][1] * halves[1][1] / power.clamp_min(1e-12)
    known = mass > 0.1 * steady.mean(mass)
    if not bool(known.any()):
        return problem
    first, second = (_centred(told[known], mass[known]) for told, _ in halves)
    common = float(steady.weighted_mean(first * second, mass[known]))
    error = float(steady.weighted_mean((first - second).square(), mass[known])) / 4
    nominal = float(steady.weighted_mean(residual.square(), weights) / steady.mean(power[known]))
    excess = max(error / max(nominal, 1e-12), 1.0)
    return replace(problem, gain_variance=max(common / excess, _LEAST_VARIANCE))


def _told(problem: JointProblem, light: Tensor, weights: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Return what some frames tell of each core's gain, less 1, and by how much light, (G,)."""
    values, light, weights = problem.values[frames], light[frames], weights[frames]
    agreement, power = (
        torch.zeros(problem.cores).to(light).index_add_(0, problem.core_index, part.sum(dim=0))
        for part in (weights * values * light, weights * light**2)
    )
    return agreement / power.clamp_min(1e-12) - 1, power


def _centred(told: Tensor, mass: Tensor) -> Tensor:
    """Return gains without what all have in common, and without extremes."""
    left = told - steady.weighted_mean(told, mass)
    far = _FAR * left.abs().median()
    return left.clamp(-far, far)
