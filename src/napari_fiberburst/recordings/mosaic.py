"""One wide picture of a long recording, solved tile by tile."""

import math
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.pyramid import CHUNK, coarsen, create_pyramid, write_tile
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.locate import Located, locating
from napari_fiberburst.recordings.outcome import Outcome, as_seen
from napari_fiberburst.recordings.outputs import (
    ENDING,
    OME_UNITS,
    check_target,
    identity,
    piece_of,
    poses_of,
    work_of,
    write_poses,
)
from napari_fiberburst.recordings.scene import equations, told_by
from napari_fiberburst.recordings.tiles import Tile, picture_of, pieces_tiled
from napari_fiberburst.recordings.traces import traced
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.work import Doing, Work, claim, complete, finish, own, room
from napari_fiberburst.scene.spline import NormalEquations
from napari_fiberburst.steps import drain
from napari_fiberburst.stored import Stored

# Nodes to a side of a tile, whole chunks; and nodes about it, in pitches: farther than that a scene does not reach.
_SIDE, _HALO = 2 * CHUNK, 8.0
# Iterations of a first scene, by which samples that show something else are told.
_DRAFT_ITERATIONS = 32
# Pixels seen by less than this many samples were filled in from those about them; farther than so many pitches from a
# sample nothing is drawn.
_LEAST_COVERAGE, _REACH = 0.05, 1.0
# What is written beside the picture: samples and frames behind each pixel, and its standard deviation.
_FURTHER = ("coverage", "uncertainty", "frames")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mosaic(Outcome):
    """A wide picture of a recording, and what else has come of it.

    Attributes
    ----------
    paths : tuple of Path
        One OME-Zarr image a piece, the largest first.
    resolution : float or None
        Pixels, the finest period on which two halves of the frames agree; None where that is not known.
    poses, track, bundle, notes, quality
        As those of `napari_fiberburst.recordings.outcome.Outcome`.
    """

    paths: tuple[Path, ...]
    resolution: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Plan(Stored):
    """What every tile needs to know."""

    _kind: ClassVar[str] = "plan of a mosaic"

    track: Track
    paths: tuple[str, ...]
    smoothness: float


def mosaic(
    source: FrameSource,
    output: str | Path,
    *,
    bundle: Bundle | None = None,
    dof: int | None = None,
    client: Any | None = None,
) -> Mosaic:
    """Make one wide picture of a recording.

    Parameters
    ----------
    source : FrameSource
        As `open_recording` gives it.
    output : str or Path
        An OME-Zarr image, ``OUT.ome.zarr``; pieces that could not be joined to the largest one become
        ``OUT-2.ome.zarr`` and so on, and the places of all frames ``OUT.poses.csv``. Work on the way is kept in
        ``OUT.work``, so that a run that was cut short goes on; it is removed at the end.
    bundle : Bundle, optional
        Where it is known; by default it is found in the frames.
    dof : int, optional
        2 where frames are only shifted, 4 where they turn and grow as well; by default as the frames ask for.
    client : distributed.Client, optional
        Where to work; by default in this process.

    Returns
    -------
    Mosaic

    Raises
    ------
    BurstError
        No two frames show the same place.
    OutputError
        The output exists, or other work was begun in its place.
    """
    return drain(mosaicking(source, output, bundle=bundle, dof=dof, client=client))


def mosaicking(
    source: FrameSource, output: str | Path, *, bundle: Bundle | None, dof: int | None, client: Any | None
) -> Generator[Doing, None, Mosaic]:
    """Make a mosaic as `mosaic` does; yields how far that is."""
    target = check_target(output, "mosaic")
    folder = work_of(target)
    claim(folder, identity(source, bundle=bundle, task="mosaic", dof=dof))
    with room(folder):
        own(folder, [target, poses_of(target)])
        return (yield from _made(source, target, folder, bundle=bundle, dof=dof, client=client))


def _made(
    source: FrameSource, target: Path, folder: Path, *, bundle: Bundle | None, dof: int | None, client: Any | None
) -> Generator[Doing, None, Mosaic]:
    located = yield from locating(source, folder, bundle=bundle, dof=dof, client=client)
    track = located.track
    if not track.pieces:
        raise BurstError(
            f"no two frames of {source.name} show the same place, or nothing moves in it; a mosaic needs frames of an "
            "object that moves, which overlap by an eighth at least; a few frames of one place are a burst: fiberburst "
            "reconstruct --frames"
        )
    told = told_by(located.traces, track, 0)
    paths = tuple(piece_of(target, piece) for piece in range(track.pieces))
    own(folder, paths)
    yield from _draw(located, paths, told.smoothness, client)
    # The picture too, though each tile was coarsened once it was drawn: a run may have been cut short between the two.
    for path in paths:
        for part in (path, *(path / name for name in _FURTHER)):
            coarsen(part)
    poses = poses_of(target)
    write_poses(poses, track, located.work.source, {piece: picture_of(track, piece) for piece in range(track.pieces)})
    finish(folder)
    resolution = None if told.agreement is None else told.agreement.resolution
    return Mosaic(
        paths=paths,
        resolution=resolution,
        poses=poses,
        track=track,
        bundle=as_seen(located.work.bundle, track),
        notes=located.notes,
        quality=located.quality,
    )


def _draw(
    located: Located, paths: tuple[Path, ...], smoothness: float, client: Any | None
) -> Generator[Doing, None, None]:
    work, track, acquisition = located.work, located.track, located.work.source.acquisition
    unit = OME_UNITS.get(acquisition.unit or "")
    work.begin("tiles")
    plan = _Plan(track=track, paths=tuple(map(str, paths)), smoothness=smoothness)
    if not work.shared("tiles").exists():  # tiles that are drawn already stay
        for piece, path in enumerate(paths):
            grid = picture_of(track, piece)
            channels = acquisition.shape[3]
            shape = grid.shape if channels == 1 else (channels, *grid.shape)
            size = acquisition.pixel_size
            names = acquisition.channel_names
            create_pyramid(path, shape, name=path.name[: -len(ENDING)], pixel_size=size, unit=unit, channels=names)
            for name in _FURTHER:
                create_pyramid(path / name, grid.shape, name=name, pixel_size=size, unit=unit)
        plan.save(work.shared("tiles"))
    tiles = _tiles(track, work.bundle.pitch)
    # What another run has drawn is seen at once; a tile at every zoom once it is drawn.
    yield Doing("solving the scene", left=len(tiles), units=len(tiles), grown=paths[0])
    for number, left in complete(draw_unit, "tiles", work, range(len(tiles)), client):
        piece, tile = tiles[number]
        coarsen(paths[piece], tile.rows, tile.columns)
        yield Doing("solving the scene", left=left, units=len(tiles), grown=paths[piece])


def draw_unit(work: Work, stage: str, number: int) -> None:
    """Solve one tile, and write it and what stands behind it: whole chunks, so that others can be written at once."""
    plan, traces, acquisition = _Plan.load(work.shared(stage)), traced(work), work.source.acquisition
    piece, tile = _tiles(plan.track, work.bundle.pitch)[number]
    frames = plan.track.touching(tile.grid, piece)
    first = equations(traces, plan.track, frames, tile.grid)
    draft = first.solve(plan.smoothness, iterations=_DRAFT_ITERATIONS)
    known = equations(traces, plan.track, frames, tile.grid, first.through(draft))
    scene = known.solve(plan.smoothness, draft)
    coverage = _coverage(known)
    most = max(float(scene.std()), 1e-6)
    deviation = known.posterior_std(plan.smoothness, plan.track.error**2, most, max(1.0, work.bundle.radius))
    seen = _seen(coverage, work.bundle.pitch)
    span = acquisition.white_level - acquisition.black_level
    light = known.image(scene, plan.smoothness) * span + work.bundle.black
    path, inner = Path(plan.paths[piece]), tile.inner
    behind = _frames_behind(plan.track, frames, tile.grid, work.bundle)
    light = torch.where(seen, light, torch.full_like(light, torch.nan))
    write_tile(path, tile.rows, tile.columns, (light if len(light) > 1 else light[0])[..., *inner].numpy())
    for name, part in zip(_FURTHER, (coverage, torch.where(seen, deviation * span, torch.nan), behind), strict=True):
        write_tile(path / name, tile.rows, tile.columns, part[inner].numpy())


def _tiles(track: Track, pitch: float) -> list[tuple[int, Tile]]:
    return pieces_tiled(track, _SIDE, math.ceil(_HALO * pitch))


def _coverage(known: NormalEquations) -> Tensor:
    """Return about how many samples have seen each node (H, W): their footprints cover it."""
    if known.radius is None:
        return known.density()
    coverage = known.through(known.density()) * math.pi * known.radius**2
    return coverage.clamp_min(0)


def _seen(coverage: Tensor, pitch: float) -> Tensor:
    """Return which nodes are seen, or lie next to one that is (H, W)."""
    reach = 2 * math.ceil(_REACH * pitch / 2) + 1
    near = torch.nn.functional.max_pool2d((coverage >= _LEAST_COVERAGE).float()[None], reach, 1, reach // 2)
    return near[0] > 0


def _frames_behind(track: Track, frames: NDArray[np.int64], grid: Grid, bundle: Bundle) -> Tensor:
    """Return how many frames have looked at each node, (H, W)."""
    outline = bundle.centres[ConvexHull(bundle.centres).vertices]
    count = np.zeros(grid.shape, np.float32)
    for matrix in track.scene_from_frame[frames]:
        places = (transform_points(matrix, outline) - (grid.x0, grid.y0)) / grid.spacing
        looked = Image.new("1", grid.shape[::-1])
        ImageDraw.Draw(looked).polygon([(x, y) for x, y in places.tolist()], fill=1)
        count += np.asarray(looked)
    return torch.from_numpy(count)
