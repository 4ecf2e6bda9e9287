"""What our solver makes of a burst when it is told the truth about everything but the scene.

Motion and bending, the bundle and how it moved on the camera, its transmission and its own light, exposures, frames
that are unusable, and what hides the object are those of the simulation. What then is lost the fault itself has taken
away: light, places that fewer frames have seen, detail that was smeared.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import lsqr
from torch import Tensor

from benchmarks.cases import Case
from napari_fiberburst import Bundle, Registration, render, solve
from napari_fiberburst.bundle.mount import Mount
from napari_fiberburst.bundle.samples import SATURATED, sample_cores, sample_pixels
from napari_fiberburst.device import find_device
from napari_fiberburst.motion.displacement import ControlGrid, Displacement
from napari_fiberburst.simulation import SimulatedBurst

# Control points of the displacement, pixels apart; it is fitted to one pixel in so many.
_SPACING, _EVERY = 12.0, 3


def told_everything(case: Case, simulated: SimulatedBurst, device: str) -> NDArray[np.float32]:
    """Return the image of frame 0, (H, W) or (H, W, C), in the burst's units."""
    whole = _whole(case)
    burst, flat = whole.burst, whole.flat
    bundle = Bundle.from_image(flat if flat.shape[2] > 1 else flat[..., 0])
    mount = Mount(whole.bundle_offsets)
    frames = torch.from_numpy(burst.frames)
    frames = mount.steadied(frames) if mount.offsets.any() else frames
    # Saturated pixels are told by their light, so they keep all of it.
    frames = torch.where(frames < SATURATED, frames - _own_light(whole), frames)
    take = sample_pixels if case.physics == "mask" else sample_cores
    samples = take(frames.to(find_device(device)), bundle, burst)
    x, y = samples.positions.round().long().cpu().T
    shows = torch.from_numpy(_shows_the_object(simulated, samples.radius)[:, y, x])
    samples = replace(samples, weights=samples.weights * shows.to(samples.weights))
    known = replace(
        Registration.known(_at_rest(whole), samples.shape, samples.cores),
        exposures=whole.exposures.astype(np.float32),
        used=whole.usable.copy(),
        displacement=None if whole.displacement is None else _as_splines(whole.displacement),
    )
    samples = mount.seen(samples) if mount.offsets.any() else samples
    return render(burst, bundle, known, solve(samples, known), fill=True)


def _whole(case: Case) -> SimulatedBurst:
    """Return the burst in its whole field: a rim and marks only hide, but cores that they cut seem to lie elsewhere."""
    return replace(
        case, faults={name: case.faults[name] for name in case.faults if name not in ("field", "overlay")}
    ).make()


def _at_rest(simulated: SimulatedBurst) -> NDArray[np.float64]:
    """Return the homographies (T, 3, 3) of frames whose bundle has been brought to rest."""
    moved = simulated.homographies.copy()
    moved[:, :, 2] += np.einsum("tij,tj->ti", moved[:, :, :2], simulated.bundle_offsets)
    return moved


def _own_light(simulated: SimulatedBurst) -> Tensor:
    """Return the light of the bundle itself in each frame, (T, H, W, C) or a zero."""
    if simulated.background is None:
        return torch.zeros(())
    exposures = torch.from_numpy(simulated.exposures.astype(np.float32))
    return exposures[:, None, None, None] * torch.from_numpy(simulated.background)


def _shows_the_object(simulated: SimulatedBurst, radius: float | None) -> NDArray[np.bool_]:
    """Return where frames show the object, (T, H, W), an intruder not even in part of a footprint of this radius."""
    shows = np.ones(simulated.truth.shape[:3], dtype=bool)
    if simulated.intruder is not None:
        reach = math.ceil(radius or 0.0)
        shows = minimum_filter(~simulated.intruder, size=(1, 2 * reach + 1, 2 * reach + 1))
    return shows if simulated.visible is None else shows & simulated.visible


def _as_splines(displacement: NDArray[np.float32]) -> Displacement:
    """Return displacements (T, H, W, 2), pixels, as splines."""
    count, height, width, _ = displacement.shape
    grid = ControlGrid.over((height, width), _SPACING)
    rows, columns = (part[::_EVERY, ::_EVERY].ravel() for part in np.indices((height, width)))
    index, weight = grid.splines(torch.from_numpy(np.stack([columns, rows], axis=1).astype(np.float32)))
    starts = np.arange(0, index.numel() + 1, index.shape[1])
    points = (len(rows), grid.shape[0] * grid.shape[1])
    basis = csr_matrix((weight.flatten().numpy(), index.flatten().numpy(), starts), shape=points)
    wanted = displacement[:, rows, columns].transpose(0, 2, 1).reshape(2 * count, -1)
    control = np.stack([lsqr(basis, one, damp=1e-4)[0] for one in wanted]).reshape(count, 2, -1)
    return Displacement(grid, torch.from_numpy(control.astype(np.float32)))
