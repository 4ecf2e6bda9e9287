"""Motion and gains of frames that moved while they were exposed, found again by a scene solved along their ways.

Registration takes a frame for a moment. A scene of smeared frames is blurred along all their ways, so that each frame
is pulled along its own, by 0.03 to 0.3 pixels for smears of a third of a step to a whole one, and gains take up what
the blur leaves. Scene, motion and gains are found in turn here, as cores have seen it.
"""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.linearised import huber
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.motion.step import MODELS, Seen, stepped
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.scene.gains import measured_gains
from napari_fiberburst.scene.smear import Smear
from napari_fiberburst.scene.spline import assemble

# So many times at most: the first halves the error of the motion, and the second takes off a fifth of the rest.
# Iterations of conjugate gradients for each scene.
_ROUNDS, _ITERATIONS = 3, 24


def refine_along(
    samples: Samples, registration: Registration, grid: Grid, smear: Smear, scene: Tensor, smoothness: float
) -> Registration:
    """Find motion and gains of smeared frames again.

    Frames that bend stay where they are, and gains that were known before are kept.

    Parameters
    ----------
    samples : Samples
        Without gains, exposures and outliers.
    registration : Registration
        Where they lie, as a moment each.
    grid : Grid
        Of the scene.
    smear : Smear
        How the frames moved meanwhile.
    scene : Tensor
        (C, H, W), a first scene.
    smoothness : float
        Of the scenes on the way.

    Returns
    -------
    Registration
        Of the same frames; the same one where a scene along their ways is not met better by what is found.
    """
    grey, scene = replace(samples, values=samples.grey[..., None]), scene.mean(dim=0, keepdim=True)
    found, least, frames = registration, np.inf, np.flatnonzero(registration.used)
    asked = registration
    for _ in range(_ROUNDS):
        points = asked.points(samples.positions)
        looks = Smear.of(smear.part, smear.way, points, frames).paths(points)
        equations = assemble(grid, grey, looks)
        scene = equations.solve(smoothness, scene, _ITERATIONS)
        filtered = equations.through(scene)
        changes, left = _steps(grey, asked, points, looks, grid, filtered[0])
        if left >= least:
            break
        found, least = asked, left
        if not samples.gains_known:
            change = _gains(grey, looks, grid, filtered)
            grey, asked = grey.without_gains(change), replace(asked, gains=asked.gains * change.cpu().numpy())
        asked = _changed(asked, changes)
    return found


def _steps(
    samples: Samples, registration: Registration, points: Tensor, looks: Tensor, grid: Grid, filtered: Tensor
) -> tuple[NDArray[np.float64], float]:
    """Return how each frame asks the scene to be moved, (T, 3, 3), and the mean square that the scene misses."""
    changes = np.tile(np.eye(3), (len(registration.used), 1, 1))
    is_rigid = registration.displacement is None and registration.dof >= MODELS[0]
    missed = mass = 0.0
    for number in np.flatnonzero(registration.used).tolist():
        sampling = grid.of_looks(looks[number])
        light, along_x, along_y = sampling.with_slopes(filtered)
        weights = samples.weights[number] * sampling.inside
        residual = samples.values[number, :, 0] - light
        missed += float(steady.total(weights * residual.square()))
        mass += float(steady.total(weights))
        if not is_rigid:
            continue
        robust = weights * huber(residual, weights)
        step = stepped(
            points[number][None],
            Seen(residual[None], robust[None], light[None], (along_x[None], along_y[None])),
            scene_from_frame=changes[number][None],
            exposures=np.ones(1, np.float32),
            shape=registration.shape,
            dof=min(registration.dof, MODELS[-1]),
        )
        changes[number] = step.scene_from_frame[0]
    return changes, missed / max(mass, 1e-12)


def _gains(samples: Samples, looks: Tensor, grid: Grid, filtered: Tensor) -> Tensor:
    """Return each core's gain relative to what samples assume, (G,).

    Not shrunk towards 1: also of eight frames, or of 600 electrons, the images gain by all of it.
    """
    ratios, light = measured_gains(samples, looks, grid, filtered)
    seen = light > 0
    return torch.where(seen, ratios / ratios[seen].median(), 1.0) if bool(seen.any()) else torch.ones_like(ratios)


def _changed(registration: Registration, changes: NDArray[np.float64]) -> Registration:
    """Return the registration after changes of the reference frame's pixels, which itself stays where it is."""
    reference, known = registration.reference, registration.registered
    relative = np.linalg.inv(changes[reference]) @ changes @ registration.reference_from_frame
    moved = registration.scene_from_frame[reference] @ relative
    found = replace(registration, scene_from_frame=np.where(known[:, None, None], moved, registration.scene_from_frame))
    return found if found.copies is None else found.with_copies(found.copies)
