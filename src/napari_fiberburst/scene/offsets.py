"""Light that cores show by themselves, such as autofluorescence and reflections, told from the object by its motion.

A core's gain multiplies the light that it sees, and its offset does not, so they are told apart by how that light
varies: for each core a line is fitted through its samples over what the scene shows to it. What all offsets have in
common no burst can tell from a brighter object, so only their differences are found.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.motion.trust import MOST_UNEXPLAINED
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.scene.prediction import predict
from napari_fiberburst.scene.solve import solve_quickly

# In pitches: between the nodes of the scene that samples are compared with; and its smoothness.
_SPACING, _SMOOTHNESS = 0.3, 0.03
# The scene is solved anew after each round, because it has followed the offsets by some part.
_ROUNDS = 3
# Offsets are taken out from this part of the mean light on (standard deviation), because smaller ones may cost less
# than their errors do: from 0.03 on, a background of 20 % gains 0.4 dB by itself, and loses 1.1 dB among other faults.
# And where they stand out of chance by so many standard errors.
_LEAST_OFFSET, _LEAST_SCORE = 0.05, 6.0
# Frames that tell an offset, at least.
_LEAST_FRAMES = 6
# A line tells an offset where it has this part of the median core's information.
_LEAST_INFORMATION = 0.05
# In median distances: offsets farther off count as if they were there.
_FAR = 8.0
# Gains change by at most this factor.
_MOST_CHANGE = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offsets:
    """What cores show by themselves.

    Attributes
    ----------
    light : Tensor
        (G, C), with gains and exposures taken out, full scale 1; 0 on average.
    gains : Tensor
        (G,) what gains that were found without offsets are to be multiplied by.
    """

    light: Tensor
    gains: Tensor

    def without(self, samples: Samples, registration: Registration) -> tuple[Samples, Registration]:
        """Return samples, as they were taken, without the offsets; and the registration with gains that go with it."""
        own = torch.from_numpy(registration.gains).to(samples.values)
        left = replace(samples, values=samples.values - (self.light * own[:, None])[samples.core_index])
        gains = (own * self.gains).cpu().numpy().astype(np.float32)
        return left, replace(registration, gains=gains)

    def added_to(self, bundle: Bundle, registration: Registration, acquisition: Acquisition) -> Bundle:
        """Return the bundle with these offsets; `registration` is that with which they were found."""
        span = acquisition.white_level - acquisition.black_level
        amplitude = self.light.cpu().numpy() * registration.gains[:, None] * bundle.gains * span
        return replace(bundle, offsets=(bundle.offsets + amplitude).astype(np.float32))


def find_offsets(samples: Samples, registration: Registration) -> Offsets | None:
    """Find how much light each core shows by itself, as far as the motion tells it.

    Parameters
    ----------
    samples : Samples
        Of whole cores, in all channels, as they were taken.
    registration : Registration
        Where they lie, and what gains to take out of them.

    Returns
    -------
    Offsets or None
        None where nothing is to be told: the object does not move, frames are few or not registered well, or no core
        shows any.
    """
    if registration.is_still or samples.kind != "cores" or int(registration.used.sum()) < _LEAST_FRAMES:
        return None
    if not registration.unexplained <= MOST_UNEXPLAINED:  # NaN where the iterations have ended early
        return None  # what frames in the wrong place leave looks like offsets
    found = None
    light = torch.zeros(samples.cores, samples.values.shape[2]).to(samples.values)
    gains = torch.ones(samples.cores).to(samples.values)
    for _ in range(_ROUNDS):
        told = _told(samples, registration, _LEAST_OFFSET if found is None else 0.0)
        if told is None:
            break
        # In units of the gains that the search has started from.
        light = light + told.light * gains[:, None]
        gains = gains * told.gains
        found = Offsets(light=light - light.mean(dim=0), gains=gains)
        samples, registration = told.without(samples, registration)
    return found


def _told(samples: Samples, registration: Registration, least: float) -> Offsets | None:
    """Return what one scene tells of offsets; None where that is chance, or less than a part of the mean light."""
    points = registration.points(samples.positions)
    grid = Grid.around(points, _SPACING * samples.pitch, 2 * samples.pitch)
    scene = solve_quickly(samples, registration, grid, _SMOOTHNESS)
    moments = torch.zeros(2, 5, *samples.values.shape[1:], dtype=torch.float64, device=points.device)
    for number, part in enumerate(predict(scene.samples, points, grid, scene.filtered)):
        off, weight = part.values - part.light, part.weights[:, None].expand_as(part.light)
        terms = (weight, weight * part.light, weight * part.light**2, weight * off, weight * off * part.light)
        moments[number % 2] += torch.stack(terms).double()
    (first, information), (second, more) = (_line(half) for half in moments)
    both, whole = _line(moments.sum(dim=0))
    mass = information * more / (information + more).clamp_min(1e-12)
    known = mass > _LEAST_INFORMATION * mass.median()
    if not bool(known.any()):
        return None
    mass = mass * known
    total = steady.total(mass).clamp_min(1e-12)
    first, second = (_centred(part, mass) for part in (first, second))
    variance = float(steady.total(mass * first * second) / total)
    chance = float(steady.total((mass * first * second).square()).sqrt() / total)
    usual = float((moments[:, 1].sum() / moments[:, 0].sum().clamp_min(1e-12)).abs())
    if variance < max((least * usual) ** 2, _LEAST_SCORE * chance):
        return None
    # What both halves agree on is the offsets, and what they do not agree on is the error of each line (Wiener).
    error = float(steady.total(mass * (first - second).square()) / total) / 4
    scale = error * float((whole * known).sum() / known.sum())
    shrunk = _centred(both, mass) * variance / (variance + scale / whole.clamp_min(1e-12))
    light = torch.where(known, shrunk, torch.zeros_like(shrunk))
    _, seen, power, _, agreement = moments.sum(dim=0)
    change = ((agreement - light * seen).sum(dim=1) / power.sum(dim=1).clamp_min(1e-12)) + 1
    change = change.clamp(1 / _MOST_CHANGE, _MOST_CHANGE)
    return Offsets(light=light.to(samples.values), gains=(change / change.median()).to(samples.values))


def _line(moments: Tensor) -> tuple[Tensor, Tensor]:
    """Return the height of each core's line (N, C) where it sees no light, and how much is known of it."""
    weight, light, power, off, agreement = moments
    slope_of_light = light / power.clamp_min(1e-12)
    information = weight - light * slope_of_light
    height = (off - slope_of_light * agreement) / information.clamp_min(1e-9)
    return height, information.clamp_min(0)


def _centred(offsets: Tensor, mass: Tensor) -> Tensor:
    """Return offsets (N, C) without what all have in common, and without extremes."""
    left = offsets - (mass * offsets).sum(dim=0) / mass.sum(dim=0).clamp_min(1e-12)
    far = _FAR * left[mass > 0].abs().median()
    return left.clamp(-far, far)
