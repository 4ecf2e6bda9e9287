"""What a scene tells of the frames that have made it: where they lie, how bright they are, and what gains cores have.

Pairs of frames leave a tenth of a pixel; the scene knows each place from many frames, so that one step of Gauss-Newton
against it leaves some hundredths. Scene and frames are found in turn.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators.grid import Grid, Sampling
from napari_fiberburst.recordings.scene import corrected, equations, frames_together
from napari_fiberburst.recordings.tiles import pieces_tiled
from napari_fiberburst.recordings.traces import Traces, traced
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.work import Work
from napari_fiberburst.scene.smoothness import UNTOLD
from napari_fiberburst.stored import Stored

# Side of the tiles on which frames are compared with the scene, nodes: all of most mosaics.
TILE_SIDE = 1024
# Iterations of conjugate gradients, at most: the scene has to be good enough to compare frames with.
_ITERATIONS = 32
# Residuals beyond so many of their root mean square count less.
_ROBUST = 2.5
# That an exposure is 1 is known as well as the light of so many cores of full brightness would tell it.
_EXPOSURE_PRIOR = 1.0
# Of a step of Gauss-Newton: pixels along an axis, relative change of exposure, and radians or relative growth, at most.
_MOST_SHIFT, _MOST_EXPOSURE, _MOST_TURN = 2.0, 0.5, 0.02
# Gains of cores that have seen less than this part of the usual light are left, and no gain changes by more than this.
_LEAST_LIGHT, _MOST_GAIN = 0.05, 5.0
# Frames turn and grow where that explains their samples better than noise would, by this ratio in the median.
_TURNING = 8.0
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
    exposures : numpy.ndarray
        (n,) float32.
    missed : numpy.ndarray
        (n,) root mean square of what the scene misses of each frame's samples, full scale 1.
    alike : numpy.ndarray
        (n,) correlation of what each frame shows with what the scene does.
    turning : numpy.ndarray
        (n,) by how much turning and growing each frame would explain it better, as a ratio to what noise explains.
    agreement, power : Tensor
        (N, C), sums over the frames of what each core shows times what the scene shows, and of the latter's square.
    """

    _kind: ClassVar[str] = "refinement"

    frames: NDArray[np.int64]
    scene_from_frame: NDArray[np.float64]
    exposures: NDArray[np.float32]
    missed: NDArray[np.float64]
    alike: NDArray[np.float64]
    turning: NDArray[np.float64]
    agreement: Tensor
    power: Tensor


def refine_unit(work: Work, stage: str, number: int) -> None:
    """Compare the frames of one tile with the scene that they and those about them make."""
    track, traces = Track.load(work.shared(stage)), traced(work)
    piece, tile = pieces_tiled(track, TILE_SIDE, halo=max(track.shape))[number]
    around = equations(traces, track, track.touching(tile.grid, piece), tile.grid)
    scene = around.solve(UNTOLD, iterations=_ITERATIONS)
    refine(traces, track, tile.of_frames(track, piece), tile.grid, around.through(scene)).save(work.path(stage, number))


def refine_units(track: Track) -> range:
    """Return the numbers of all units of `refine_unit`."""
    return range(len(pieces_tiled(track, TILE_SIDE, halo=max(track.shape))))


def refine(traces: Traces, track: Track, frames: NDArray[np.int64], grid: Grid, filtered: Tensor) -> Refinement:
    """Compare frames with the scene (C, H, W) as cores see it."""
    found = [_compare(traces, track, some, grid, filtered) for some in frames_together(traces, frames)]
    _, cores, channels = traces.template.values.shape
    none = torch.zeros(cores, channels)
    return Refinement(
        frames=frames,
        **{
            name: np.concatenate([getattr(part, name) for part in found]) if found else getattr(track, same)[frames]
            for name, same in (
                ("scene_from_frame", "scene_from_frame"),
                ("exposures", "exposures"),
                ("missed", "alike"),
                ("alike", "alike"),
                ("turning", "alike"),
            )
        },
        agreement=sum((part.agreement for part in found), none),
        power=sum((part.power for part in found), none),
    )


def _compare(traces: Traces, track: Track, frames: NDArray[np.int64], grid: Grid, filtered: Tensor) -> Refinement:
    samples = corrected(traces, track, frames)
    points = track.points(frames, traces.template.positions)
    sampling = grid.at(points)
    weights = samples.weights * sampling.inside
    light, along_x, along_y = sampling.with_slopes(filtered.mean(dim=0))
    residual = samples.grey - light
    typical = (_sums(weights, residual.square()) / weights.sum(dim=1).clamp_min(1e-9)).sqrt().clamp_min(1e-6)
    robust = weights / (1 + (residual / (_ROBUST * typical[:, None])).square())
    exposures, matrices, turning = _stepped(track, frames, points, robust, residual, light, (along_x, along_y))
    agreement, power = _light(samples, sampling, robust, filtered)
    return Refinement(
        frames=frames,
        scene_from_frame=matrices,
        exposures=exposures,
        missed=typical.double().numpy(),
        alike=_correlation(samples.grey, light, weights).double().numpy(),
        turning=turning / typical.double().numpy() ** 2,
        agreement=agreement,
        power=power,
    )


def _light(samples: Samples, sampling: Sampling, weights: Tensor, filtered: Tensor) -> tuple[Tensor, Tensor]:
    light = sampling.of_channels(filtered)
    weighted = weights[..., None] * light
    return (weighted * samples.values).sum(dim=0), (weighted * light).sum(dim=0)


def _stepped(
    track: Track,
    frames: NDArray[np.int64],
    points: Tensor,
    weights: Tensor,
    residual: Tensor,
    light: Tensor,
    slopes: tuple[Tensor, Tensor],
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """Return exposures and places of frames after one step of Gauss-Newton each.

    And by how much of the residuals' square a turn and a growth would lower it, half of that for each.
    """
    along_x, along_y = slopes
    half = max(track.shape) / 2
    middle = (points * weights[..., None]).sum(dim=1) / weights.sum(dim=1).clamp_min(1e-9)[:, None]
    x, y = ((points - middle[:, None]) / half).unbind(dim=-1)
    turns = [half * (x * along_x + y * along_y), half * (x * along_y - y * along_x)]
    jacobian = torch.stack([light, along_x, along_y, *turns], dim=1)
    weighted = jacobian * weights[:, None]
    normal = weighted @ jacobian.mT
    normal = normal + torch.diag_embed(1e-4 * normal.diagonal(dim1=1, dim2=2) + 1e-9)
    normal[:, 0, 0] += _EXPOSURE_PRIOR
    rhs = (weighted @ residual[..., None])[..., 0]
    whole = torch.linalg.solve(normal, rhs)
    shifted = torch.linalg.solve(normal[:, :3, :3], rhs[:, :3])
    turning = ((whole * rhs).sum(dim=1) - (shifted * rhs[:, :3]).sum(dim=1)) / 2
    step = (shifted if track.dof == 2 else whole).double().numpy()
    exposures = track.exposures[frames] * (1 + step[:, 0].clip(-_MOST_EXPOSURE, _MOST_EXPOSURE)).astype(np.float32)
    grown, turned = step[:, 3:].clip(-_MOST_TURN, _MOST_TURN).T if track.dof > 2 else np.zeros((2, len(frames)))
    change = np.zeros((len(frames), 3, 3))
    change[:, 0, 0] = change[:, 1, 1] = 1 + grown
    change[:, 1, 0], change[:, 0, 1], change[:, 2, 2] = turned, -turned, 1
    centre = middle.double().numpy()
    shift = step[:, 1:3].clip(-_MOST_SHIFT, _MOST_SHIFT)
    change[:, :2, 2] = shift + centre - np.einsum("nij,nj->ni", change[:, :2, :2], centre)
    return exposures, change @ track.scene_from_frame[frames], turning.double().numpy()


def refined(track: Track, parts: list[Refinement]) -> Track:
    """Return the track as parts of the scene know it.

    The exposures of a piece keep the geometric mean 1, and the gains the median 1: no more can be told of them. Frames
    that are unlike the scene are taken out of their piece.
    """
    if not parts:
        return track
    matrices, exposures, alike = (getattr(track, name).copy() for name in ("scene_from_frame", "exposures", "alike"))
    missed = np.full(len(track), np.nan)
    for part in parts:
        matrices[part.frames], exposures[part.frames] = part.scene_from_frame, part.exposures
        missed[part.frames], alike[part.frames] = part.missed, part.alike
    piece = np.where(alike >= _LEAST_ALIKE, track.piece, -1)
    for number in range(track.pieces):
        own = piece == number
        exposures[own] /= np.exp(np.log(exposures[own]).mean()) if own.any() else 1
    agreement, power = (
        torch.stack([getattr(part, name) for part in parts]).sum(dim=0) for name in ("agreement", "power")
    )
    known = power > _LEAST_LIGHT * power.median()
    ratio = torch.where(known, agreement / power.clamp_min(1e-12), torch.ones_like(power))
    gains = track.gains * ratio.clamp(1 / _MOST_GAIN, _MOST_GAIN).numpy()
    usual = float(np.nanmedian(missed))
    turning = float(np.median(np.concatenate([part.turning for part in parts])))
    return replace(
        track,
        scene_from_frame=matrices,
        piece=piece,
        exposures=exposures,
        gains=gains / np.median(gains, axis=0),
        weights=np.nan_to_num((usual / np.maximum(missed, usual)) ** 2).astype(np.float32),
        alike=alike,
        error=usual,
        dof=4 if turning > _TURNING else track.dof,
    )


def _sums(weights: Tensor, values: Tensor) -> Tensor:
    return (weights * values).sum(dim=1)


def _correlation(first: Tensor, second: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted correlation of rows (n, N), (n,); 0 where there is nothing to compare."""
    mass = weights.sum(dim=1).clamp_min(1e-9)[:, None]
    first, second = (part - _sums(weights, part)[:, None] / mass for part in (first, second))
    power = _sums(weights, first.square()) * _sums(weights, second.square())
    return torch.where(power > 0, _sums(weights, first * second) / power.clamp_min(1e-20).sqrt(), 0.0)
