"""Gather what a self-calibrated picture rests on."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.pipeline.alignment import Alignment
from napari_fiberburst.results.diagnostics import Cores
from napari_fiberburst.results.reconstruction import Canvas
from napari_fiberburst.scene.spline import Normal

# Less than this part of a sample is the rim of one.
_LEAST_COVERAGE = 0.1


def bundle_evidence(aligned: Alignment, grid: Grid, canvas: Canvas, acquisition: Acquisition) -> dict[str, Any]:
    """Return the fields of `napari_fiberburst.results.diagnostics.Evidence` that calibration and registration tell."""
    transmission = (aligned.calibration.transmission * _spread_gains(aligned)).cpu().numpy().astype(np.float32)
    if "C" in acquisition.axes:
        transmission = np.repeat(transmission[..., None], acquisition.shape[3], axis=2)
    return {
        "coverage": _coverage(aligned, grid, canvas),
        "transmission": transmission,
        "cores": _cores(aligned) if aligned.calibration.is_resolved else None,
        "frames_used": tuple(int(number) for number in np.flatnonzero(aligned.used)),
        "confidence": aligned.confidence,
        "reference": aligned.reference,
        "notes": tuple(aligned.notes),
    }


def fit_evidence(
    aligned: Alignment, normal: Normal, scene: Tensor, canvas: Canvas, smoothness: float, acquisition: Acquisition
) -> dict[str, Any]:
    """Return the fields of `napari_fiberburst.results.diagnostics.Evidence` that the solved scene tells."""
    span = acquisition.white_level - acquisition.black_level
    residuals, variance = _residuals(aligned, normal, scene)
    most = max(float(scene.std()), 1e-6)
    deviation = normal.deviation(smoothness, variance, most, max(1.0, aligned.calibration.radius))
    expected = normal.grid.at(_places(canvas, scene)).read(deviation)
    return {
        "uncertainty": (expected * span).cpu().numpy().astype(np.float32),
        "residuals": (residuals * span).cpu().numpy().astype(np.float32),
    }


def _places(canvas: Canvas, like: Tensor) -> Tensor:
    return torch.from_numpy(canvas.points().astype(np.float32)).to(like.device)


def _residuals(aligned: Alignment, normal: Normal, scene: Tensor) -> tuple[Tensor, float]:
    """Return the root mean square residual per frame and core, (T, N), and the variance of samples of weight 1."""
    seen, points = aligned.observation, aligned.points()
    through = normal.through(scene)
    cores = len(aligned.calibration.centres)
    found = torch.full((len(seen.weights), cores), torch.nan).to(through)
    total = mass = 0.0
    for number, weights in enumerate(seen.weights):
        if not aligned.used[number]:
            continue
        at = normal.grid.at(points[number])
        light = torch.stack([at.read(channel) for channel in through], dim=1)
        weight = weights * at.inside
        square = ((seen.values[number] - light) ** 2).mean(dim=1) * weight
        sums, weights_sum = (
            torch.zeros(cores).to(through).index_add_(0, seen.sources, part) for part in (square, weight)
        )
        found[number] = torch.where(weights_sum > 0, (sums / weights_sum.clamp_min(1e-12)).sqrt(), found[number])
        total += float(square.sum())
        mass += float(weight.sum())
    return found, total / max(mass, 1e-12)


def _coverage(aligned: Alignment, grid: Grid, canvas: Canvas) -> NDArray[np.float32]:
    """Return how many samples have seen each pixel (H, W): their footprint covers it, or they lie in it."""
    seen, points = aligned.observation, aligned.points()
    places = _places(canvas, points)
    count = torch.zeros(grid.shape).to(places)
    for number, weights in enumerate(seen.weights):
        if aligned.used[number]:
            count += grid.at(points[number, weights > 0]).write(torch.ones(int((weights > 0).sum())).to(places))
    if seen.radius is None:
        coverage = grid.at(places).read(count) / grid.spacing**2
    else:
        area = math.pi * (seen.radius / grid.spacing) ** 2
        coverage = grid.at(places).read(Footprint(grid, seen.radius)(count)) * area
    coverage[coverage < _LEAST_COVERAGE] = 0
    array: NDArray[np.float32] = coverage.cpu().numpy().astype(np.float32)
    return array


def _spread_gains(aligned: Alignment) -> Tensor:
    """Return each pixel's core's gain, (H, W)."""
    return torch.cat([aligned.gains, torch.ones(1).to(aligned.gains)])[
        aligned.calibration.labels.clamp(max=len(aligned.gains))
    ]


def _cores(aligned: Alignment) -> Cores:
    calibration = aligned.calibration
    own = calibration.labels < len(calibration.centres)
    labels = calibration.labels[own]
    count = len(calibration.centres)
    light = torch.zeros(count).to(aligned.gains).index_add_(0, labels, calibration.transmission[own] ** 2)
    mass = torch.zeros(count).to(aligned.gains).index_add_(0, labels, calibration.transmission[own])
    weights = aligned.observation.weights
    usable = torch.zeros(len(weights), count).to(weights).index_add_(1, aligned.observation.sources, weights)
    usable = usable[torch.from_numpy(aligned.used)] > 0
    return Cores(
        centres=calibration.centres.cpu().numpy().astype(np.float64),
        gains=(light / mass.clamp_min(1e-9) * aligned.gains).cpu().numpy().astype(np.float64),
        radius=calibration.radius,
        pitch=calibration.pitch,
        saturated=(usable.float().mean(dim=0) < 0.5).cpu().numpy(),
        dead=calibration.dead,
    )
