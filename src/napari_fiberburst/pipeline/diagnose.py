"""Judge a reconstruction: what it rests on, how sure it is, and what it says of the bundle."""

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.noise import Noise
from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.bundle.transmission import with_gains
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.pipeline.context import frames_behind
from napari_fiberburst.pipeline.goodness import collect
from napari_fiberburst.pipeline.verdict import is_smeared_far, judge
from napari_fiberburst.results.diagnostics import Diagnostics
from napari_fiberburst.scene.gains import measured_gains
from napari_fiberburst.scene.prediction import predict
from napari_fiberburst.scene.smear import Smear
from napari_fiberburst.scene.solve import Scene
from napari_fiberburst.scene.spline import assemble

# Less than this part of a sample is the rim of one.
_LEAST_COVERAGE = 0.1
# Iterations of conjugate gradients for what a scene makes of wrong gains; and the least part that it does not follow.
_PROBE_ITERATIONS, _LEAST_FREE = 8, 0.05
# A core is saturated that has no sample in this part of the frames.
_MOSTLY = 0.5


def diagnose(
    acquisition: Acquisition,
    bundle: Bundle,
    registration: Registration,
    scene: Scene,
    canvas: Canvas | None = None,
    *,
    notes: tuple[str, ...] = (),
    noise: Noise | None = None,
    is_scene_shown: bool = True,
) -> Diagnostics:
    """Return what is known of a reconstruction beside its image.

    Parameters
    ----------
    acquisition : Acquisition
        Of the burst.
    bundle : Bundle
        That its samples were taken with.
    registration : Registration
        Where they lie.
    scene : Scene
        That they were solved for.
    canvas : Canvas, optional
        Of the image; by default the field of the reference frame, pixel for pixel.
    notes : tuple of str
        What is known to be wrong already.
    noise : Noise, optional
        Of the camera, by `napari_fiberburst.bundle.noise.measure_noise`; without, errors are taken with the noise that
        is in them.
    is_scene_shown : bool
        Whether the image shows this scene; where a network shows it instead, what holds for the scene alone
        (uncertainty, residuals, held-out error) is left open.
    """
    samples = scene.samples
    points = registration.points(samples.positions)
    looks = scene.looks(points)
    canvas = Canvas.over((0, 0, samples.shape[1], samples.shape[0])) if canvas is None else canvas
    span = acquisition.white_level - acquisition.black_level
    ratios, weights = measured_gains(samples, looks, scene.grid, scene.filtered)
    ratios, weights = _held_to_others(ratios, weights, scene, looks, registration)
    found = Diagnostics(
        coverage=_coverage(samples, points, registration, scene.grid, canvas),
        context=frames_behind(samples, points, registration.used, canvas),
        bundle=_as_seen(bundle, registration, scene, weights),
        gain_ratios=ratios.cpu().numpy().astype(np.float32),
        gain_weights=weights.cpu().numpy().astype(np.float32),
        frames_used=tuple(int(number) for number in np.flatnonzero(registration.used)),
        confidence=registration.confidence,
        exposures=np.where(registration.used, registration.exposures, np.nan).astype(np.float64),
        reference=registration.reference,
        notes=notes,
        outliers=None if scene.outliers is None else _per_core(scene.outliers, samples),
    )
    if not is_scene_shown:
        return found
    residuals, variance = _residuals(samples, looks, scene)
    most = max(float(scene.coefficients.std()), 1e-6)
    std = scene.equations.posterior_std(scene.smoothness, variance, most, max(1.0, bundle.radius))
    expected = scene.grid.at(_places(canvas, std))(std)
    fit = collect(scene, registration, _variance(noise, bundle, acquisition, registration, samples))
    verdict = judge(fit, registration, bundle.pitch, gains_known=bundle.gains_known)
    told = () if is_smeared_far(fit, bundle.pitch) else _told(scene.smear)
    return replace(
        found,
        quality=verdict.quality,
        misfit=fit.misfit if math.isfinite(fit.misfit) else None,
        notes=(*notes, *told, *verdict.reasons),
        uncertainty=(expected * span).cpu().numpy().astype(np.float32),
        residuals=(residuals * span).cpu().numpy().astype(np.float32),
        held_out_rmse=None if scene.held_out_rmse is None else scene.held_out_rmse * span,
        resolution=scene.resolution,
        agreement=scene.agreement,
    )


def _variance(
    noise: Noise | None, bundle: Bundle, acquisition: Acquisition, registration: Registration, samples: Samples
) -> Tensor | None:
    """Return the noise's variance of one channel of samples as they were solved, (T, N); None where unknown."""
    if noise is None or samples.kind != "cores":
        return None
    exposures, gains = (
        torch.from_numpy(part).to(samples.values) for part in (registration.exposures, registration.gains)
    )
    factors = exposures[:, None] * gains[samples.core_index]
    taken = replace(samples, values=samples.grey[..., None] * factors[..., None])
    return samples.values.shape[2] * noise.of_samples(bundle, acquisition, taken) / factors**2


def _told(smear: Smear | None) -> tuple[str, ...]:
    """Return what a user should know of frames that moved while they were exposed."""
    if smear is None:
        return ()
    return (
        f"frames moved by {smear.length:.1f} px (rms) while they were exposed; the scene is solved along their paths",
    )


def _per_core(outliers: Tensor, samples: Samples) -> NDArray[np.bool_]:
    """Return which cores have an outlier among their samples, (T, G) bool."""
    counts = torch.zeros(len(outliers), samples.cores).index_add_(1, samples.core_index.cpu(), outliers.cpu().float())
    array: NDArray[np.bool_] = (counts > 0).numpy()
    return array


def _held_to_others(
    ratios: Tensor, weights: Tensor, scene: Scene, points: Tensor, registration: Registration
) -> tuple[Tensor, Tensor]:
    """Return gains (G,) as other cores see them, and what light they rest on.

    The scene was solved from a core's own samples too, so it follows an error of the core's gain by some part: the gain
    seems nearer to 1 than it is, and less is known of it than its light would tell. That part is measured: gains that
    are wrong at random are put before the scene. A burst that does not move follows them all the way.
    """
    if registration.is_still:
        return torch.ones_like(ratios), torch.zeros_like(weights)
    samples = scene.samples
    generator = torch.Generator().manual_seed(0)
    signs = (2 * torch.randint(2, (samples.cores,), generator=generator) - 1).to(points)[samples.core_index]
    light = torch.zeros_like(samples.weights)
    for part in predict(samples, points, scene.grid, scene.filtered.mean(dim=0, keepdim=True)):
        light[part.frame] = part.light[:, 0]
    wrong = replace(samples, values=(signs * light)[..., None])
    equations = assemble(scene.grid, wrong, points)
    followed = equations.through(equations.solve(scene.smoothness, iterations=_PROBE_ITERATIONS))
    agreement = power = torch.zeros(()).to(points)
    for part in predict(wrong, points, scene.grid, followed):
        agreement = agreement + steady.total(part.weights * (part.values * part.light)[:, 0])
        power = power + steady.total(part.weights * part.values[:, 0] ** 2)
    free = min(max(1 - float(agreement / power.clamp_min(1e-12)), _LEAST_FREE), 1.0)
    return (1 + (ratios - 1) / free).clamp_min(0), weights * free


def _places(canvas: Canvas, like: Tensor) -> Tensor:
    return torch.from_numpy(canvas.points().astype(np.float32)).to(like.device)


def _residuals(samples: Samples, points: Tensor, scene: Scene) -> tuple[Tensor, float]:
    """Return the root mean square residual per frame and core, (T, N), and the variance of samples of weight 1."""
    filtered = scene.filtered
    found = torch.full((len(samples.weights), samples.cores), torch.nan).to(filtered)
    total = mass = 0.0
    for number, values, light, weight in predict(samples, points, scene.grid, filtered):
        square = ((values - light) ** 2).mean(dim=1) * weight
        of_cores, weights = (
            torch.zeros(samples.cores).to(filtered).index_add_(0, samples.core_index, part) for part in (square, weight)
        )
        found[number] = torch.where(weights > 0, (of_cores / weights.clamp_min(1e-12)).sqrt(), found[number])
        total += float(steady.total(square))
        mass += float(steady.total(weight))
    return found, total / max(mass, 1e-12)


def _coverage(
    samples: Samples, points: Tensor, registration: Registration, grid: Grid, canvas: Canvas
) -> NDArray[np.float32]:
    """Return how many samples have seen each pixel (H, W): their footprint covers it, or they lie in it."""
    places = _places(canvas, points)
    count = torch.zeros(grid.shape).to(places)
    for number in np.flatnonzero(registration.used):
        used = samples.weights[number] > 0
        count += grid.at(points[number, used]).adjoint(torch.ones(int(used.sum())).to(places))
    if samples.radius is None:
        coverage = grid.at(places)(count) / grid.spacing**2
    else:
        area = math.pi * (samples.radius / grid.spacing) ** 2
        coverage = grid.at(places)(Footprint(grid, samples.radius, count.device)(count)) * area
    coverage[coverage < _LEAST_COVERAGE] = 0
    array: NDArray[np.float32] = coverage.cpu().numpy().astype(np.float32)
    return array


def _as_seen(bundle: Bundle, registration: Registration, scene: Scene, weights: Tensor) -> Bundle:
    """Return the bundle as this burst shows it: with the gains of its pixels and channels, and its saturated cores.

    Where the gains were not known before, and the object moves, this burst has measured them.
    """
    samples, gains = scene.samples, scene.gains
    bundle = with_gains(bundle, torch.from_numpy(registration.gains), gains.channels)
    transmission = bundle.transmission
    if gains.shares is not None:
        x, y = samples.positions.cpu().numpy().astype(np.intp).T
        transmission = transmission.copy()
        transmission[y, x] *= gains.shares.cpu().numpy()
    used = samples.weights[torch.from_numpy(registration.used)]
    usable = torch.zeros(len(used), samples.cores).to(used).index_add_(1, samples.core_index, used) > 0
    is_measured = not bundle.gains_known and not registration.is_still
    return replace(
        bundle,
        transmission=transmission,
        gain_weights=weights.cpu().numpy().astype(np.float32) if is_measured else bundle.gain_weights,
        saturated=(usable.float().mean(dim=0) < _MOSTLY).cpu().numpy(),
    )
