"""One wide picture of a long recording, solved tile by tile."""

import csv
import io
import math
import shutil
from collections.abc import Generator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import BurstError, OutputError
from napari_fiberburst.io.pyramid import CHUNK, coarsen, create_pyramid, write_tile
from napari_fiberburst.io.results import check_place, write_whole
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.locate import Located, locating
from napari_fiberburst.recordings.scene import equations, told_by
from napari_fiberburst.recordings.tiles import Tile, picture_of, pieces_tiled
from napari_fiberburst.recordings.traces import traced
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.work import Doing, Work, claim, complete
from napari_fiberburst.scene.spline import NormalEquations
from napari_fiberburst.steps import drain
from napari_fiberburst.stored import Stored

ENDING = ".ome.zarr"
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
class Mosaic:
    """What has come of a recording.

    Attributes
    ----------
    paths : tuple of Path
        One OME-Zarr image a piece, the largest first.
    poses : Path
        The table of all frames' places.
    track : Track
        The same.
    resolution : float or None
        Pixels, the finest period on which two halves of the frames agree; None where that is not known.
    notes : tuple of str
        What a user should know.
    quality : str
        "good", or "doubtful" where the notes say why the picture may be wrong.
    """

    paths: tuple[Path, ...]
    poses: Path
    track: Track
    resolution: float | None
    notes: tuple[str, ...]
    quality: Literal["good", "doubtful"]


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
    target = check_mosaic(output)
    stem = target.name[: -len(ENDING)]
    folder = target.with_name(stem + ".work")
    claim(folder, identity(source, bundle=bundle, task="mosaic", dof=dof))
    located = yield from locating(source, folder, bundle=bundle, dof=dof, client=client)
    track = located.track
    if not track.pieces:
        raise BurstError(
            f"no two frames of {source.name} show the same place, or nothing moves in it; a mosaic needs frames of an "
            "object that moves, which overlap by an eighth at least; a few frames of one place are a burst: fiberburst "
            "reconstruct --frames"
        )
    told = told_by(located.traces, track, 0)
    further = (target.with_name(f"{stem}-{piece + 1}{ENDING}") for piece in range(1, track.pieces))
    paths = (target, *further)
    yield from _draw(located, paths, told.smoothness, client)
    for path in paths:
        for part in (path, *(path / name for name in _FURTHER)):
            coarsen(part)
    poses = target.with_name(stem + ".poses.csv")
    write_poses(poses, track, located.work.source)
    shutil.rmtree(folder)
    resolution = None if told.agreement is None else told.agreement.resolution
    return Mosaic(
        paths=paths, poses=poses, track=track, resolution=resolution, notes=located.notes, quality=located.quality
    )


def check_mosaic(output: str | Path) -> Path:
    """Refuse a path that a mosaic cannot be written to, before long work rather than after it.

    Raises
    ------
    OutputError
        It has another ending, is there already, or its folder cannot be written.
    """
    target = Path(output)
    if not target.name.endswith(ENDING):
        raise OutputError(f"a mosaic is written to a folder ending in {ENDING}; got {output}")
    folder = target.with_name(target.name[: -len(ENDING)] + ".work")
    if target.exists() and not folder.exists():
        raise OutputError(f"{target} is there already; choose another name, or remove it")
    check_place(folder.with_suffix(".poses.csv"))
    return target


def identity(source: FrameSource, *, bundle: Bundle | None, **settings: Any) -> dict[str, Any]:
    """Return what work on a recording is told by, as plain values."""
    return {
        "recording": source.fingerprint,
        "bundle": None if bundle is None else bundle.digest(),
        "version": version("napari-fiberburst"),
        **settings,
    }


def _draw(
    located: Located, paths: tuple[Path, ...], smoothness: float, client: Any | None
) -> Generator[Doing, None, None]:
    work, track, acquisition = located.work, located.track, located.work.source.acquisition
    unit = {"µm": "micrometer", "nm": "nanometer", "mm": "millimeter"}.get(acquisition.unit or "")
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
    units = range(len(_tiles(track, work.bundle.pitch)))
    for _, left in complete(draw_unit, "tiles", work, units, client):
        yield Doing("solving the scene", left=left, units=len(units))


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


def write_poses(path: Path, track: Track, source: FrameSource) -> None:
    """Write where frames lie as CSV: frame, seconds, piece, used, and h00 to h22.

    The matrix leads from frame pixels to pixels of the piece's picture, (x, y), integers at pixel centres.
    """
    times = source.acquisition.times
    origins = {piece: picture_of(track, piece) for piece in range(track.pieces)}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", "seconds", "piece", "used", *(f"h{i}{j}" for i in range(3) for j in range(3))])
    for number, (matrix, piece) in enumerate(zip(track.planes(), track.piece, strict=True)):
        seconds = "" if times is None else repr(float(times[number]))
        if piece < 0:
            writer.writerow([number, seconds, "", 0, *[""] * 9])
            continue
        grid = origins[int(piece)]
        placed = np.array([[1, 0, -grid.x0], [0, 1, -grid.y0], [0, 0, 1]]) @ matrix
        writer.writerow([number, seconds, int(piece), 1, *(repr(float(value)) for value in placed.ravel())])
    with write_whole(path) as stream:
        stream.write(text.getvalue().encode())
