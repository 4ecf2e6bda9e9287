"""How smooth the scene should be, chosen by what one part of the burst tells of another."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.quality.resolution import RingCorrelation, RingSpectra, correlation_of, ring_spectra
from napari_fiberburst.scene.prediction import misfit
from napari_fiberburst.scene.spline import assemble
from napari_fiberburst.scene.window import liveliest

# Smoothness is looked for among these where neighbours tell, and between them.
_STILL_CANDIDATES = tuple(10 ** (exponent / 2) for exponent in range(5, -4, -1))
_STILL_ITERATIONS = 40
# Where halves of the burst tell, it is looked for among these; the halves' own is so rough that even the finest detail
# is in them.
_CANDIDATES = np.geomspace(10, 3e-4, 120)
_ROUGH = 0.003
# The smoothness where it cannot be told.
UNTOLD = 0.1
# Smoothness is chosen in a window of at most this many nodes a side.
_WINDOW = 224
# Of waves that pass by less, nothing is known.
_LEAST_TRANSFER = 1e-6
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


def choose_smoothness(
    samples: Samples, points: Tensor, frames: NDArray[np.intp], grid: Grid, scene: Tensor
) -> Smoothness:
    """Choose the smoothness at which the scene's error is least, by how halves of the burst agree at each frequency.

    Even and odd frames are solved apart and hardly smoothed. What their spectra have in common is the scene, what they
    have not is noise, both as these solutions pass them; so it is known what error any other would have: see
    `_expected_error`. Samples left out cannot tell: a footprint hides from them just the detail, and the noise, that
    matter.

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
    in_grey = replace(samples, values=samples.grey[..., None])
    halves = [assemble(window, in_grey, points, among_frames(half, samples)) for half in (frames[::2], frames[1::2])]
    densities = [blur(half.density(), 3.0) for half in halves]
    both = torch.minimum(*densities)
    sampled = (both > 0.2 * both.max()) & (both > 0)
    if not bool(sampled.any()):
        return Smoothness(UNTOLD, None)
    first, second = (half.image(half.solve(_ROUGH), _ROUGH)[0].cpu().numpy() for half in halves)
    soft = (blur(sampled.to(scene), 4.0) * sampled).cpu().numpy()
    spectra = ring_spectra(first, second, soft)
    density = float(np.mean([float(steady.mean(half.density()[sampled])) for half in halves]))
    errors = _expected_error(spectra, *halves[0].responses(spectra.frequency), density, _ROUGH)
    weight = float(_CANDIDATES[np.argmin(errors)]) if np.isfinite(errors).all() else UNTOLD
    return Smoothness(weight, correlation_of(spectra).in_pixels(window.spacing))


def _expected_error(
    spectra: RingSpectra,
    passed: NDArray[np.float64],
    prior: NDArray[np.float64],
    density: float,
    rough: float,
) -> NDArray[np.float64]:
    """Return the error that a scene from both halves is expected to have at each candidate.

    With the density c of samples, the footprint's response B and the prior's P, a solution passes the part
    c B^2 / (c B^2 + lambda P) of a wave, and the noise sigma^2 c B^2 / (c B^2 + lambda P)^2 of samples (Wahba, "Spline
    models for observational data", 1990, chapter 4). That is undone for the halves, and done for all samples, at twice
    the density. A scene's spectrum falls off, which says what it is where the footprint lets nothing through; the noise
    of samples is white, so its variance is the median over the waves that pass, because what is wrong with gains and
    motion shows in the longest ones.

    Parameters
    ----------
    spectra : RingSpectra
        Of the halves.
    passed, prior : numpy.ndarray
        (F,) B^2 and P at its frequencies.
    density : float
        Of a half, samples to a node.
    rough : float
        lambda of the halves.
    """
    # The lowest ring is what leaks from the mean and the window's edge.
    count, passed, prior = spectra.count[1:], passed[1:], prior[1:]
    common, noise = spectra.cross[1:], spectra.noise[1:]
    stiff = density * passed + rough * prior
    transfer = np.maximum(density * passed / stiff, _LEAST_TRANSFER)
    trust = count * transfer**4 / (np.abs(common) + noise + np.finfo(float).tiny) ** 2
    falling = isotonic_regression(common / transfer**2, weights=trust / trust.max(), increasing=False)
    power = np.maximum(falling.x, 0)
    of_samples = noise * stiff**2 / (density * np.maximum(passed, _LEAST_TRANSFER))
    variance = weighted_median(of_samples, count * passed)
    weight = _CANDIDATES[:, None] * prior
    all_stiff = 2 * density * passed + weight
    errors = (weight / all_stiff) ** 2 * power + 2 * density * passed * variance / all_stiff**2
    return np.asarray(errors @ count)


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
