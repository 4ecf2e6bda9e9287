"""How smooth the scene should be, chosen by what one part of the burst tells of another."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.quality.resolution import RingCorrelation, RingSpectra, correlation_of, ring_spectra
from napari_fiberburst.scene.power import fit_power
from napari_fiberburst.scene.prediction import misfit
from napari_fiberburst.scene.rehearsal import Rehearsal
from napari_fiberburst.scene.spline import NormalEquations, assemble
from napari_fiberburst.scene.window import liveliest

# Smoothness is looked for among these where neighbours tell, and between them.
_STILL_CANDIDATES = tuple(10 ** (exponent / 2) for exponent in range(5, -4, -1))
_STILL_ITERATIONS = 40
# That of the halves of a burst.
_ROUGH = 0.003
# The smoothness where it cannot be told.
UNTOLD = 0.1
# Smoothness is chosen in a window of at most this many nodes a side.
_WINDOW = 224
# Where halves of the burst tell, it is looked for in steps of this factor from UNTOLD, at first that many, and between
# these.
_STEP, _FIRST_STEP, _STEPS = 3.0, -2, (-6, 4)
_REHEARSED_ITERATIONS = 16
# At least this part of what halves differ by is taken for noise: a small rest of large numbers tells nothing.
_LEAST_OWN = 0.25
# Of the halves; more tell no more, because what these pass is measured.
_ROUGH_ITERATIONS = 25
# Halves that have less power than this in common, at full scale 1, show nothing but how numbers are rounded.
_NOTHING = 1e-13
# Every core is left out once, with so many others that most of its neighbours stay.
_FOLDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Smoothness:
    """How smooth the scene should be, and down to what detail halves of the burst agree.

    Attributes
    ----------
    weight : float
        lambda.
    agreement : RingCorrelation or None
        Of two halves of the burst, in frame pixels; None where that could not be told.
    """

    weight: float
    agreement: RingCorrelation | None


@dataclass(frozen=True, slots=True, eq=False)
class _Passing:
    """What two solutions, each from one half of the burst, pass at the frequencies of their spectra.

    Attributes
    ----------
    scene : numpy.ndarray
        (F,) part of the scene's power that both show.
    gaps : numpy.ndarray
        (F,) power of what the scene itself makes them differ by, because they look at other places.
    noise : numpy.ndarray
        (F,) power that samples of variance 1 give to one.
    """

    scene: NDArray[np.float64]
    gaps: NDArray[np.float64]
    noise: NDArray[np.float64]


def choose_smoothness(
    samples: Samples, points: Tensor, frames: NDArray[np.intp], grid: Grid, scene: Tensor
) -> Smoothness:
    """Choose the smoothness at which the scene's error is least, by how halves of the burst agree at each frequency.

    Even and odd frames are solved apart and hardly smoothed. What their spectra have in common is the scene, what they
    have not is noise, both as these solutions pass them. How they do is at first taken to be as of even sampling, and
    then measured: a scene of the spectrum found is seen at the same places, and solved. So is the error of the whole
    at one smoothness after the other; see `napari_fiberburst.scene.rehearsal`. Samples left out cannot tell: a
    footprint hides from them just the detail, and the noise, that matter.

    Parameters
    ----------
    samples, points
        The samples, and where they look (T, N, 2), or (T, N, K, 2) where that moves.
    frames : numpy.ndarray
        Numbers of the frames that take part, at least two.
    grid : Grid
        Of the scene.
    scene : Tensor
        (H, W), a first scene on that grid: the window is laid where it has most structure.
    """
    window = liveliest(grid, scene, _WINDOW)
    samples, points = _in_window(samples, points, frames, window)
    numbers = np.arange(len(frames))
    halves = [among_frames(half, samples) for half in (numbers[::2], numbers[1::2])]

    def equations_of(some: Samples) -> list[NormalEquations]:
        return [assemble(window, some, points, half) for half in halves]

    # Conjugate gradients would take what is left of the mean light for a part of the detail.
    solved = equations_of(_without_mean(samples))
    densities = [blur(half.density(), 3.0) for half in solved]
    both = torch.minimum(*densities)
    sampled = (both > 0.2 * both.max()) & (both > 0)
    if not bool(sampled.any()):
        return Smoothness(UNTOLD, None)
    soft = (blur(sampled.to(scene), 4.0) * sampled).cpu().numpy()
    images = [_hardly_smoothed(half) for half in solved]
    spectra = _mean_spectra(images[0], images[1], soft)
    in_grey = ring_spectra(images[0].mean(axis=0), images[1].mean(axis=0), soft)
    agreement = correlation_of(in_grey).in_pixels(window.spacing)
    if not spectra.cross[1:].max() > _NOTHING:
        return Smoothness(UNTOLD, agreement)
    passed, prior = solved[0].responses(spectra.frequency)
    density = float(np.mean([float(steady.mean(half.density()[sampled])) for half in solved]))

    power, _ = _told(spectra, _as_if_even(passed, prior, density), passed)
    rehearsal = Rehearsal.of(window, samples, points, spectra.frequency[1:], power)
    passing = _measured(rehearsal, [_hardly_smoothed(half) for half in equations_of(rehearsal.scene_and_noise)], soft)
    power, variance = _told(spectra, passing, passed)
    rehearsal = Rehearsal.of(window, samples, points, spectra.frequency[1:], power)
    equations = assemble(window, rehearsal.samples, points)
    return Smoothness(_least_error(rehearsal, equations, variance), agreement)


def _in_window(samples: Samples, points: Tensor, frames: NDArray[np.intp], window: Grid) -> tuple[Samples, Tensor]:
    """Return the samples that look into a window in one of these frames, and where; without all other frames.

    What is drawn at random depends on how many there are, and frames that take no part must not count.
    """
    looks = torch.zeros(len(samples.positions), dtype=torch.bool, device=points.device)
    for number in frames.tolist():
        looks |= window.of_looks(points[number]).inside & (samples.weights[number] > 0)
    there = torch.from_numpy(frames).to(points.device)[:, None], looks.nonzero()[:, 0]
    seen = replace(
        samples,
        positions=samples.positions[looks],
        values=samples.values[there],
        weights=samples.weights[there],
        core_index=samples.core_index[looks],
    )
    return seen, points[there]


def _without_mean(samples: Samples) -> Samples:
    mean = [steady.weighted_mean(channel, samples.weights) for channel in samples.values.unbind(dim=-1)]
    return replace(samples, values=samples.values - torch.stack(mean))


def _hardly_smoothed(half: NormalEquations) -> NDArray[np.float32]:
    """Return the image (C, H, W) that a half shows; it is so rough that even the finest detail is in it."""
    image: NDArray[np.float32] = half.image(half.solve(_ROUGH, iterations=_ROUGH_ITERATIONS), _ROUGH).cpu().numpy()
    return image


def _mean_spectra(first: NDArray[np.float32], second: NDArray[np.float32], soft: NDArray[np.float32]) -> RingSpectra:
    """Return the spectra of two images (C, H, W), the mean over their channels: each has noise of its own."""
    parts = [ring_spectra(one, other, soft) for one, other in zip(first, second, strict=True)]
    powers = np.mean([part.powers for part in parts], axis=0)
    return replace(parts[0], cross=np.mean([part.cross for part in parts], axis=0), powers=(powers[0], powers[1]))


def _as_if_even(passed: NDArray[np.float64], prior: NDArray[np.float64], density: float) -> _Passing:
    """Return what halves would pass, were sampling even.

    With the density c of samples, the footprint's response B and the prior's P, a solution passes the part
    c B^2 / (c B^2 + lambda P) of a wave, and the noise sigma^2 c B^2 / (c B^2 + lambda P)^2 of samples (Wahba, "Spline
    models for observational data", 1990, chapter 4).
    """
    stiff = density * passed + _ROUGH * prior
    noise = density * passed / stiff**2
    return _Passing(scene=(density * passed / stiff) ** 2, gaps=np.zeros_like(noise), noise=noise)


def _measured(rehearsal: Rehearsal, images: list[NDArray[np.float32]], soft: NDArray[np.float32]) -> _Passing:
    """Return what halves pass of a scene that is known, and of noise."""
    nodes = rehearsal.nodes.cpu().numpy()
    there = np.maximum(ring_spectra(nodes, nodes, soft).cross, np.finfo(float).tiny)
    shown = [np.maximum(ring_spectra(image[0], nodes, soft).cross / there, 0) for image in images]
    return _Passing(
        scene=shown[0] * shown[1],
        gaps=ring_spectra(images[0][0], images[1][0], soft).noise,
        noise=ring_spectra(images[0][1], images[1][1], soft).noise,
    )


def _told(spectra: RingSpectra, passing: _Passing, passed: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the power of the scene (F - 1,) and the variance of samples of weight 1, from the spectra of halves (F,).

    The lowest ring is what leaks from the mean and the window's edge. The noise of samples is white, so its variance is
    the median over the waves that pass, `passed` by the footprint, because what is wrong with gains and motion shows in
    the longest ones.
    """
    count, scene, noise = spectra.count[1:], passing.scene[1:], passing.noise[1:]
    power = fit_power(spectra.frequency[1:], spectra.cross[1:], spectra.noise[1:], count, scene)
    own = np.maximum(spectra.noise[1:] - passing.gaps[1:], _LEAST_OWN * spectra.noise[1:])
    return power, weighted_median(own / np.maximum(noise, np.finfo(float).tiny), count * passed[1:] * scene)


def _least_error(rehearsal: Rehearsal, equations: NormalEquations, variance: float) -> float:
    """Return the smoothness at which a scene that is known is solved best from all samples, with noise of `variance`.

    It is walked to in even steps of its logarithm, and found between them by a parabola.
    """
    errors: dict[int, float] = {}
    scene, before = None, UNTOLD

    def error(step: int) -> float:
        nonlocal scene, before
        if step not in errors:
            weight = UNTOLD * _STEP**step
            start = None if scene is None else equations.carried(scene, before, weight)
            scene, before = equations.solve(weight, start, _REHEARSED_ITERATIONS), weight
            missed, of_noise = rehearsal.errors(equations, scene, weight)
            errors[step] = missed + variance * of_noise
        return errors[step]

    best = _FIRST_STEP
    while True:
        better = min((best - 1, best, best + 1), key=error)
        if better == best or not _STEPS[0] < better < _STEPS[1]:
            break
        best = better
    below, middle, above = (math.log(errors[best + step]) for step in (-1, 0, 1))
    curve = below - 2 * middle + above
    offset = 0.5 * (below - above) / curve if curve > 0 else 0.0
    return float(UNTOLD * _STEP ** (best + min(max(offset, -0.5), 0.5)))


def weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the value with half of the weight below it."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, below[-1] / 2)])


def choose_among_neighbours(
    samples: Samples, points: Tensor, frames: NDArray[np.intp], grid: Grid, scene: Tensor
) -> Smoothness:
    """Choose the smoothness by which each core is best predicted from those around it.

    For a burst that does not move. Its halves share every gap, and what cores differ by: neither half tells which part
    of the other's image is object and which is core. Between neighbours, cores differ at random and the object does
    not, so the smoothness that predicts cores left out (cross-validation in folds) takes out what is the cores'.

    Parameters are those of `choose_smoothness`; one frame is enough.
    """
    window = liveliest(grid, scene, _WINDOW)
    in_grey, taking_part = replace(samples, values=samples.grey[..., None]), among_frames(frames, samples)
    count = samples.weights.shape[1]
    fold = torch.randperm(count, generator=torch.Generator().manual_seed(0)).to(points.device) % _FOLDS
    risks = np.zeros(len(_STILL_CANDIDATES))
    for left in range(_FOLDS):
        normal = assemble(window, in_grey, points, taking_part & (fold != left))
        asked = taking_part & (fold == left)
        guess = normal.mean()  # from the smooth side, because the smoothest scenes take many iterations to settle
        for index, smoothness in enumerate(_STILL_CANDIDATES):
            guess = normal.solve(smoothness, guess, _STILL_ITERATIONS)
            risks[index] += misfit(in_grey, points, window, normal.through(guess), asked)[0]
    return Smoothness(_lowest(risks, _STILL_CANDIDATES) if risks.any() else UNTOLD, None)


def among_frames(frames: NDArray[np.intp], samples: Samples) -> Tensor:
    """Return which samples are of these frames, (T, 1) bool."""
    among = torch.zeros(len(samples.weights), 1, dtype=torch.bool)
    among[torch.from_numpy(frames)] = True
    return among.to(samples.weights.device)


def _lowest(risks: NDArray[np.float64], candidates: tuple[float, ...]) -> float:
    """Return the smoothness of least risk, by a parabola through the lowest candidate and its neighbours."""
    index = int(np.argmin(risks))
    exponents = np.log10(candidates)
    if not 0 < index < len(risks) - 1:
        return candidates[index]
    near = slice(index - 1, index + 2)
    curve = np.polyfit(exponents[near], np.log(risks[near] + 1e-300), 2)
    lowest = -curve[1] / (2 * curve[0]) if curve[0] > 0 else exponents[index]
    return float(10 ** np.clip(lowest, exponents[index + 1], exponents[index - 1]))
