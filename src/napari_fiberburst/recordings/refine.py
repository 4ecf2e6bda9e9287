"""What a scene tells of the frames that have made it: where they lie, how bright they are, and what gains cores have.

Pairs of frames leave a tenth of a pixel; the scene knows each place from many frames, so that one step of Gauss-Newton
against it leaves some hundredths. Scene and frames are found in turn.
"""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.step import MODELS, Seen, stepped
from napari_fiberburst.operators.grid import Grid, Sampling
from napari_fiberburst.recordings import rows
from napari_fiberburst.recordings.bending import Bend, basis, control_grid
from napari_fiberburst.recordings.scene import corrected, equations, frames_together
from napari_fiberburst.recordings.tiles import Tile, pieces_tiled
from napari_fiberburst.recordings.traces import Traces, traced
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.work import Work
from napari_fiberburst.scene.smoothness import UNTOLD, weighted_median
from napari_fiberburst.stored import Stored

# Side of the tiles on which frames are compared with the scene, nodes, at most. They are of one size, because workers
# would wait for the one that has the largest.
TILE_SIDE = 896
# Nodes about a tile, beyond half of a frame, that the scene has to be right in.
_MARGIN = 16
# Iterations of conjugate gradients, at most: the scene has to be good enough to compare frames with.
_ITERATIONS = 32
# Residuals beyond so many of their root mean square count less.
_ROBUST = 2.5
# Gains of cores that have seen less than this part of the usual light are left, and no gain changes by more than this.
_LEAST_LIGHT, _MOST_GAIN = 0.05, 5.0
# A larger model is asked for where it explains the median frame better than noise would by this ratio.
_ASKED = 4.0
# One frame in so many is asked whether it bends; where the median one of these would keep more than this part of what
# the scene misses, frames do not.
_ASKED_OF, _LEFT_BY_BENDING = 8, 0.97
# Frames that are less like the scene than this do not belong to it.
_LEAST_ALIKE = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement(Stored):
    """What a part of the scene tells of some frames.

    Attributes
    ----------
    frames : numpy.ndarray
        (n,), their numbers.
    scene_from_frame : numpy.ndarray
        (n, 3, 3), where they lie.
    control : numpy.ndarray or None
        (n, 2, M), how they bend.
    exposures : numpy.ndarray
        (n,) float32.
    missed : numpy.ndarray
        (n,) root mean square of what the scene misses of each frame's samples, full scale 1.
    alike : numpy.ndarray
        (n,) correlation of what each frame shows with what the scene does.
    asked : numpy.ndarray
        (n, 2) by how much turning and growing, and stretching beside them, would explain each frame better, for each
        unknown, in mean squares of what the scene misses: what noise alone makes of it is about 1.
    strain, certainty : numpy.ndarray
        (n, 4) by how much the scene is grown, turned and stretched where each frame lies, as a frame that may do so
        tells it; and one over the variance of each.
    rarity : numpy.ndarray
        (n,) as that of `Track`, within a core distance.
    bending : numpy.ndarray
        (n,) what part of its root mean square a first bend would leave of what the scene misses of a frame; NaN where
        that was not asked.
    agreement, power : Tensor
        (N, C), sums over the frames, weighed by their rarity, of what each core shows times what the scene shows, and
        of the latter's square.
    """

    _kind: ClassVar[str] = "refinement"

    frames: NDArray[np.int64]
    scene_from_frame: NDArray[np.float64]
    control: NDArray[np.float32] | None
    exposures: NDArray[np.float32]
    missed: NDArray[np.float64]
    alike: NDArray[np.float64]
    asked: NDArray[np.float64]
    strain: NDArray[np.float64]
    certainty: NDArray[np.float64]
    rarity: NDArray[np.float64]
    bending: NDArray[np.float64]
    agreement: Tensor
    power: Tensor


def refine_unit(work: Work, stage: str, number: int) -> None:
    """Compare the frames of one tile with the scene that they and those about them make."""
    track, traces = Track.load(work.shared(stage)), traced(work)
    piece, tile = _tiles(track)[number]
    around = equations(traces, track, track.touching(tile.grid, piece), tile.grid)
    scene = around.solve(UNTOLD, iterations=_ITERATIONS)
    refine(traces, track, tile.of_frames(track, piece), tile.grid, around.through(scene)).save(work.path(stage, number))


def refine_units(track: Track) -> range:
    """Return the numbers of all units of `refine_unit`."""
    return range(len(_tiles(track)))


def halo_of(shape: tuple[int, int]) -> int:
    """Return how many nodes about a tile hold frames (height, width) whose middles lie in it, turned in any way."""
    return math.ceil(math.hypot(*shape) / 2) + _MARGIN


def _tiles(track: Track) -> list[tuple[int, Tile]]:
    return pieces_tiled(track, TILE_SIDE, halo_of(track.shape), is_even=True)


def refine(traces: Traces, track: Track, frames: NDArray[np.int64], grid: Grid, filtered: Tensor) -> Refinement:
    """Compare frames with the scene (C, H, W) as cores see it."""
    rarity = track.rarity(traces.template.pitch)
    found = [_compare(traces, track, some, grid, filtered, rarity[some]) for some in frames_together(traces, frames)]
    _, cores, channels = traces.template.values.shape
    none = torch.zeros(cores, channels)
    return Refinement(
        frames=frames,
        scene_from_frame=np.concatenate([part.scene_from_frame for part in found] or [np.zeros((0, 3, 3))]),
        control=None
        if track.control is None
        else np.concatenate([track.control[:0], *(part.control for part in found if part.control is not None)]),
        exposures=np.concatenate([part.exposures for part in found] or [np.zeros(0, np.float32)]),
        missed=np.concatenate([part.missed for part in found] or [np.zeros(0)]),
        alike=np.concatenate([part.alike for part in found] or [np.zeros(0)]),
        asked=np.concatenate([part.asked for part in found] or [np.zeros((0, 2))]),
        strain=np.concatenate([part.strain for part in found] or [np.zeros((0, 4))]),
        certainty=np.concatenate([part.certainty for part in found] or [np.zeros((0, 4))]),
        rarity=np.concatenate([part.rarity for part in found] or [np.zeros(0)]),
        bending=np.concatenate([part.bending for part in found] or [np.zeros(0)]),
        agreement=sum((part.agreement for part in found), none),
        power=sum((part.power for part in found), none),
    )


def _compare(
    traces: Traces,
    track: Track,
    frames: NDArray[np.int64],
    grid: Grid,
    filtered: Tensor,
    rarity: NDArray[np.float64],
) -> Refinement:
    samples = corrected(traces, track, frames)
    points = track.points(frames, traces.template.positions)
    sampling = grid.at(points)
    weights = samples.weights * sampling.inside
    light, along_x, along_y = sampling.with_slopes(filtered.mean(dim=0))
    residual = samples.grey - light
    typical = rows.rms(residual, weights)[:, 0]
    robust = weights / (1 + (residual / (_ROBUST * typical[:, None])).square())
    slopes = along_x, along_y
    step = stepped(
        points,
        Seen(residual, robust, light, slopes),
        scene_from_frame=track.scene_from_frame[frames],
        exposures=track.exposures[frames],
        shape=track.shape,
        dof=track.dof,
    )
    bend = Bend(basis(track.shape, traces.template.positions), track.shape, robust, step.left, slopes, typical)
    control, told = None, np.full(len(frames), np.nan)
    if track.control is not None:
        control = torch.from_numpy(track.control[frames])
        control = control + torch.stack([bend.step(number, one)[0] for number, one in enumerate(control)])
    elif track.dof == MODELS[-1]:
        for number in np.flatnonzero(frames % _ASKED_OF == 0).tolist():
            told[number] = bend.step(number, None)[1]
    agreement, power = _light(samples, sampling, robust * torch.from_numpy(rarity)[:, None].to(robust), filtered)
    variance = typical.double().numpy()[:, None] ** 2
    return Refinement(
        frames=frames,
        scene_from_frame=step.scene_from_frame,
        control=None if control is None else control.numpy(),
        exposures=step.exposures,
        missed=typical.double().numpy(),
        alike=rows.correlation(samples.grey, light, weights).double().numpy(),
        asked=step.lowered / variance,
        strain=step.strain,
        certainty=step.information / variance,
        rarity=rarity,
        bending=told,
        agreement=agreement,
        power=power,
    )


def _light(samples: Samples, sampling: Sampling, weights: Tensor, filtered: Tensor) -> tuple[Tensor, Tensor]:
    light = sampling.of_channels(filtered)
    weighted = weights[..., None] * light
    return (weighted * samples.values).sum(dim=0), (weighted * light).sum(dim=0)


def refined(track: Track, parts: list[Refinement]) -> Track:
    """Return the track as parts of the scene know it.

    The exposures of a piece keep the geometric mean 1, and the gains the median 1: no more can be told of them. Frames
    that are unlike the scene are taken out of their piece.
    """
    if not parts:
        return track
    matrices, exposures, alike = (getattr(track, name).copy() for name in ("scene_from_frame", "exposures", "alike"))
    control = None if track.control is None else track.control.copy()
    missed, rarity = np.full(len(track), np.nan), np.zeros(len(track))
    for part in parts:
        matrices[part.frames], exposures[part.frames] = part.scene_from_frame, part.exposures
        missed[part.frames], alike[part.frames], rarity[part.frames] = part.missed, part.alike, part.rarity
        if control is not None and part.control is not None:
            control[part.frames] = part.control
    piece = np.where(alike >= _LEAST_ALIKE, track.piece, -1)
    for number in range(track.pieces):
        own = piece == number
        exposures[own] /= np.exp(np.log(exposures[own]).mean()) if own.any() else 1
    agreement, power = (
        torch.stack([getattr(part, name) for part in parts]).sum(dim=0) for name in ("agreement", "power")
    )
    known = power > _LEAST_LIGHT * power.median()
    ratio = torch.where(known, agreement / power.clamp_min(1e-12), torch.ones_like(power))
    light = torch.where(known, power, torch.zeros_like(power)).mean(dim=1)
    gains = track.gains * ratio.clamp(1 / _MOST_GAIN, _MOST_GAIN).numpy()
    usual = weighted_median(missed[rarity > 0], rarity[rarity > 0])
    return replace(
        track,
        scene_from_frame=matrices,
        control=control,
        piece=piece,
        exposures=exposures,
        gains=gains / np.median(gains, axis=0),
        gain_weights=light.numpy(),
        weights=np.nan_to_num((usual / np.maximum(missed, usual)) ** 2).astype(np.float32),
        alike=alike,
        error=usual,
    )


def bending(track: Track) -> Track:
    """Return the track of frames that may bend, and do not yet."""
    rows, columns = control_grid(track.shape).shape
    return replace(track, control=np.zeros((len(track), 2, rows * columns), np.float32))


def ask_to_bend(parts: list[Refinement]) -> bool:
    """Whether frames may bend: those that were asked would be explained better."""
    told = np.concatenate([part.bending for part in parts] or [np.zeros(0)])
    return bool(np.isfinite(told).any()) and float(np.nanmedian(told)) < _LEFT_BY_BENDING


def larger_model(track: Track, parts: list[Refinement]) -> int:
    """Return the degrees of freedom that the frames ask for: those they have, or the next more.

    It can be told once gains and exposures have settled; before, what is wrong with them asks for it, too.
    """
    if not parts or track.dof == MODELS[-1]:
        return track.dof
    step = MODELS.index(track.dof)
    asked = np.concatenate([part.asked for part in parts])[:, step]
    return MODELS[step + 1] if len(asked) and np.median(asked) > _ASKED else track.dof
