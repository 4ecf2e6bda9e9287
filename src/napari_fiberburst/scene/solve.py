"""Step 4: solve the scene for samples whose places are known, at a smoothness that sets itself."""

import math
from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.quality.resolution import RingCorrelation
from napari_fiberburst.scene.gains import GainChange, refine_gains
from napari_fiberburst.scene.outliers import find_outliers
from napari_fiberburst.scene.prediction import misfit
from napari_fiberburst.scene.smear import Smear, find_smear
from napari_fiberburst.scene.smoothness import UNTOLD, Smoothness, choose_among_neighbours, choose_smoothness
from napari_fiberburst.scene.spline import NormalEquations, assemble
from napari_fiberburst.steps import drain
from napari_fiberburst.stored import Stored

# Iterations of conjugate gradients, at most, for a scene on the way. Gains and outliers are told by that scene, so it
# has to have settled where few frames look, too.
_DRAFT_ITERATIONS = 32
# From a scene that has some samples which it should not.
_MORE_ITERATIONS = 24
PREVIEW_ITERATIONS = 8
# In pitches (standard deviation): over this distance a place has samples nearby.
_NEAR = 0.5
# Outliers are looked for so many times: in the first scene, they are in the scene too.
_OUTLIER_ROUNDS = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene(Stored):
    """The scene as a linear spline, and what it was solved from.

    Attributes
    ----------
    coefficients : Tensor
        (C, H, W) at the nodes of the grid of `equations`, light above black, full scale 1.
    smoothness : float
        Weight of the prior.
    equations : NormalEquations
        That it solves.
    samples : Samples
        That it was solved from, their gains taken out.
    gains : GainChange
        That were taken out of the samples on the way.
    outliers : Tensor or None
        (T, N) bool, samples that show something else, and have no weight; None where they have not been looked for.
    smear : Smear or None
        How the frames moved while they were exposed; None where that was not seen.
    is_draft : bool
        Whether its smoothness is a usual one that has not been chosen yet.
    agreement : RingCorrelation or None
        Of two halves of the burst, frequency by frequency, in frame pixels; None where that is not known.
    held_out_rmse : float or None
        Root mean square error, full scale 1, of samples left out of the fit, before they were taken in.
    """

    _kind: ClassVar[str] = "scene"

    coefficients: Tensor
    smoothness: float
    equations: NormalEquations
    samples: Samples
    gains: GainChange
    outliers: Tensor | None = None
    smear: Smear | None = None
    is_draft: bool = True
    agreement: RingCorrelation | None = None
    held_out_rmse: float | None = None

    @property
    def resolution(self) -> float | None:
        """Pixels, the finest period on which two halves of the burst agree; None where that is not known."""
        if self.agreement is None or not math.isfinite(self.agreement.resolution):
            return None
        return self.agreement.resolution

    @property
    def grid(self) -> Grid:
        """Where the nodes are."""
        return self.equations.grid

    def looks(self, points: Tensor) -> Tensor:
        """Return where samples that lie at points (T, N, 2) look: these, or (T, N, K, 2) where they moved meanwhile."""
        return points if self.smear is None else self.smear.paths(points)

    @property
    def filtered(self) -> Tensor:
        """The scene as samples see it through their footprint, (C, H, W)."""
        return self.equations.through(self.coefficients)

    @property
    def image(self) -> Tensor:
        """The smooth image that the spline stands for, at the nodes, (C, H, W)."""
        return self.equations.image(self.coefficients, self.smoothness)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Draft:
    """What a first scene has told of its samples: all that solving needs to go on from, at any smoothness.

    Attributes
    ----------
    coefficients : Tensor
        (C, H, W), the first scene, at a usual smoothness: where solving starts from.
    gains, outliers, smear, agreement
        As those of `Scene`.
    smoothness : float or None
        That the burst itself asks for; None where it has not been asked.
    """

    coefficients: Tensor
    gains: GainChange
    outliers: Tensor | None
    smear: Smear | None
    smoothness: float | None
    agreement: RingCorrelation | None

    def refined(self, samples: Samples, registration: Registration) -> Samples:
        """Return samples as they were taken without the gains, exposures and outliers that are known."""
        samples = self.gains.taken_out_of(registration.correct(samples))
        if self.outliers is None:
            return samples
        return replace(samples, weights=samples.weights * ~self.outliers)

    def looks(self, samples: Samples, registration: Registration) -> Tensor:
        """Return where samples look, (T, N, 2), or (T, N, K, 2) where they moved while a frame was exposed."""
        points = registration.points(samples.positions)
        return points if self.smear is None else self.smear.paths(points)


def solve(
    samples: Samples,
    registration: Registration,
    grid: Grid | None = None,
    *,
    smoothness: float | None = None,
    held_out: float = 0.05,
    seed: int = 0,
) -> Scene:
    """Solve the scene for motion and gains as they are.

    Parameters
    ----------
    samples : Samples
        In all channels, as they were taken.
    registration : Registration
        Where they lie, and what gains to take out of them.
    grid : Grid, optional
        Nodes of the scene, in pixels of the reference frame; by default one for each of its pixels, and a margin.
    smoothness : float, optional
        Weight of the prior; more is smoother. By default it is chosen by what one part of the samples tells of another.
    held_out : float
        Part of the samples that is left out at first and tells how well the scene predicts, 0 to 0.5.
    seed : int
        Draws which samples those are.

    Returns
    -------
    Scene
        Solved from all samples.
    """
    if grid is None:
        height, width = samples.shape
        grid = grid_over((0, 0, width - 1, height - 1), 1.0, samples.pitch + (samples.radius or 0.0))
    return drain(solving(samples, registration, grid, smoothness=smoothness, held_out=held_out, seed=seed))


def grid_over(bounds: tuple[float, float, float, float], spacing: float, reach: float) -> Grid:
    """Return a grid over x0, y0, x1, y1 and `reach` pixels about it; a node lies on (x0, y0)."""
    margin = spacing * math.ceil(reach / spacing)
    x0, y0, x1, y1 = bounds
    return Grid.over((x0 - margin, y0 - margin, x1 + margin, y1 + margin), spacing)


def solve_quickly(
    samples: Samples, registration: Registration, grid: Grid, smoothness: float | None, dark: Tensor | None = None
) -> Scene:
    """Return a first scene, for a preview; `dark` as for `drafting`."""
    return _draft(
        registration.correct(samples),
        registration.points(samples.positions),
        grid,
        smoothness,
        iterations=PREVIEW_ITERATIONS,
        dark=dark,
    )


def prediction_error(samples: Samples, registration: Registration, grid: Grid, *, seed: int) -> float:
    """Return by how much a tenth of the samples is missed by a scene of the others, relative to their mean light."""
    samples, points = registration.correct(samples), registration.points(samples.positions)
    left_out = _left_out(samples, 0.1, seed)
    equations = assemble(grid, samples, points, (~left_out).to(points))
    coefficients = equations.solve(UNTOLD, iterations=_DRAFT_ITERATIONS)
    missed, mass = misfit(samples, points, grid, equations.through(coefficients), left_out)
    light = float(steady.weighted_mean(samples.grey, samples.weights))
    return (missed / mass) ** 0.5 / max(light, 1e-9) if mass > 0 else math.inf


def solving(
    samples: Samples,
    registration: Registration,
    grid: Grid,
    *,
    smoothness: float | None,
    held_out: float,
    seed: int,
) -> Generator[Scene, None, Scene]:
    """Solve as `solve` does; yields a draft, twice, and the scene before held-out samples are taken in."""
    draft = yield from drafting(samples, registration, grid, is_asked=smoothness is None)
    return (
        yield from finishing(draft, samples, registration, grid, smoothness=smoothness, held_out=held_out, seed=seed)
    )


def drafting(
    samples: Samples, registration: Registration, grid: Grid, *, is_asked: bool, dark: Tensor | None = None
) -> Generator[Scene, None, Draft]:
    """Learn from a first scene what solving needs to know of the samples; yields that scene, twice.

    It does not depend on the smoothness that the scene will have, so one draft serves them all. `is_asked` tells
    whether the burst is to choose that; what halves of it agree on is found anyhow. `dark` are nodes where frames are
    dark, (H, W) bool, as `NormalEquations.darkened` takes them.
    """
    samples = registration.correct(samples)
    points = registration.points(samples.positions)
    scene = _draft(samples, points, grid, None, dark=dark)
    if not registration.is_still:
        samples, gains = refine_gains(samples, points, grid, scene.filtered)
        scene = _without_outliers(replace(scene, samples=samples, gains=gains), points)
        samples = scene.samples
        smear = find_smear(samples, points, np.flatnonzero(registration.used), grid, scene.filtered, scene.coefficients)
        scene = replace(scene, smear=smear)
        points = scene.looks(points)
    yield scene
    # Of a burst that stands still only the smoothness would be learned, and that takes long.
    is_told = is_asked or not registration.is_still
    told = _choose(scene, points, registration) if is_told else Smoothness(UNTOLD, None)
    yield replace(scene, agreement=told.agreement)
    return Draft(
        coefficients=scene.coefficients,
        gains=scene.gains,
        outliers=scene.outliers,
        smear=scene.smear,
        smoothness=told.weight if is_told else None,
        agreement=told.agreement,
    )


def finishing(
    draft: Draft,
    samples: Samples,
    registration: Registration,
    grid: Grid,
    *,
    smoothness: float | None,
    held_out: float,
    seed: int,
    dark: Tensor | None = None,
) -> Generator[Scene, None, Scene]:
    """Solve the scene for good from its draft; yields it before held-out samples are taken in."""
    weight = smoothness or draft.smoothness or UNTOLD
    looks, samples = draft.looks(samples, registration), draft.refined(samples, registration)
    left_out = _left_out(samples, held_out, seed)
    equations = assemble(grid, samples, looks, (~left_out).to(looks))
    coefficients = _darkened(equations, dark, samples).solve(weight, draft.coefficients)
    missed, mass = misfit(samples, looks, grid, equations.through(coefficients), left_out)
    scene = Scene(
        coefficients=coefficients,
        smoothness=weight,
        equations=equations.without_paths(),
        samples=samples,
        gains=draft.gains,
        outliers=draft.outliers,
        smear=draft.smear,
        is_draft=False,
        agreement=draft.agreement,
        held_out_rmse=(missed / mass) ** 0.5 if mass > 0 else None,
    )
    yield scene
    if not left_out.any():
        return scene
    equations = equations + assemble(grid, samples, looks, left_out.to(looks))
    coefficients = _darkened(equations, dark, samples).solve(weight, coefficients)
    return replace(scene, coefficients=coefficients, equations=equations.without_paths())


def _draft(
    samples: Samples,
    points: Tensor,
    grid: Grid,
    smoothness: float | None,
    iterations: int = _DRAFT_ITERATIONS,
    dark: Tensor | None = None,
) -> Scene:
    equations = assemble(grid, samples, points)
    weight = UNTOLD if smoothness is None else smoothness
    coefficients = _darkened(equations, dark, samples).solve(weight, iterations=iterations)
    return Scene(coefficients=coefficients, smoothness=weight, equations=equations, samples=samples, gains=GainChange())


def _darkened(equations: NormalEquations, dark: Tensor | None, samples: Samples) -> NormalEquations:
    """Return the equations to solve. Those to keep are of the samples alone: nothing was measured in the dark."""
    return equations if dark is None else equations.darkened(dark, _NEAR * samples.pitch)


def _without_outliers(scene: Scene, points: Tensor) -> Scene:
    """Return the scene from samples without those that show something else; its coefficients are as they were.

    They are told in grey, and looked for again in a scene without the first.
    """
    samples = scene.samples
    grey = replace(samples, values=samples.grey[..., None])
    coefficients, filtered = (part.mean(dim=0, keepdim=True) for part in (scene.coefficients, scene.filtered))
    outliers = torch.zeros_like(samples.weights, dtype=torch.bool)
    for number in range(_OUTLIER_ROUNDS):
        if number > 0:
            equations = assemble(scene.grid, replace(grey, weights=grey.weights * ~outliers), points)
            coefficients = equations.solve(scene.smoothness, coefficients, _MORE_ITERATIONS)
            filtered = equations.through(coefficients)
        outliers = find_outliers(grey, points, scene.grid, filtered)
        if not bool(outliers.any()):
            break
    return replace(scene, samples=replace(samples, weights=samples.weights * ~outliers), outliers=outliers)


def _choose(scene: Scene, points: Tensor, registration: Registration) -> Smoothness:
    samples = scene.samples
    if registration.is_still and samples.radius is None:
        return Smoothness(UNTOLD, None)
    choose = choose_among_neighbours if registration.is_still else choose_smoothness
    return choose(samples, points, np.flatnonzero(registration.used), scene.grid, scene.coefficients.mean(dim=0))


def _left_out(samples: Samples, part: float, seed: int) -> Tensor:
    """Return which samples (T, N) are left out to tell the error."""
    generator = torch.Generator().manual_seed(seed)
    chance = torch.rand(samples.weights.shape, generator=generator).to(samples.weights.device)
    return (chance < part) & (samples.weights > 0)
