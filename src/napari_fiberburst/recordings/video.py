"""Every frame of a recording, reconstructed from those about it in time."""

from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.io.pyramid import create_pyramid
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.locate import Located, locating
from napari_fiberburst.recordings.movie import check_movie, film_source, write_movie
from napari_fiberburst.recordings.outcome import Outcome, as_seen
from napari_fiberburst.recordings.outputs import (
    ENDING,
    OME_UNITS,
    check_target,
    identity,
    poses_of,
    traces_of,
    work_of,
    write_poses,
)
from napari_fiberburst.recordings.regions import check_regions, create_traces, numbers_of, write_table
from napari_fiberburst.recordings.smoothness import smoothness_for
from napari_fiberburst.recordings.stretch import STRETCH, Plan, solve_unit
from napari_fiberburst.recordings.tiles import picture_of
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.window import window_for
from napari_fiberburst.recordings.work import Doing, claim, complete, finish, is_begun, own, room
from napari_fiberburst.steps import drain

# A stabilised video shows the whole picture where that has at most so many times the pixels of a frame.
_MOST_FIELDS = 4.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Video(Outcome):
    """Every frame of a recording, and what else has come of it.

    Frames that are not used are shown alone, or not at all.

    Attributes
    ----------
    path : Path
        The OME-Zarr video, (T, H, W) or (T, C, H, W), in the recording's own units.
    traces : Path
        The Zarr group of traces.
    table : Path or None
        The traces of the regions as CSV; None without regions.
    movie : Path or None
        The video file to look at; None where none was asked for.
    window : int
        How many frames stand behind each.
    poses, track, bundle, notes, quality
        As those of `napari_fiberburst.recordings.outcome.Outcome`.
    """

    path: Path
    traces: Path
    table: Path | None
    movie: Path | None
    window: int


def video(
    source: FrameSource,
    output: str | Path,
    *,
    bundle: Bundle | None = None,
    dof: int | None = None,
    window: int | None = None,
    stabilised: bool = False,
    regions: NDArray[np.integer] | None = None,
    mp4: str | Path | None = None,
    scale_bar: bool = False,
    client: Any | None = None,
) -> Video:
    """Reconstruct every frame of a recording from those about it.

    Light that differs from frame to frame as a whole, the exposure, is taken out; what changes in a part of the picture
    stays, in the frame that shows it.

    Parameters
    ----------
    source : FrameSource
        As `open_recording` gives it.
    output : str or Path
        An OME-Zarr video, ``OUT.ome.zarr``, float32 in the recording's units, NaN where nothing was seen. Beside it are
        written ``OUT.poses.csv``, ``OUT.traces.zarr`` and, with regions, ``OUT.traces.csv``. Work on the way is kept
        in ``OUT.work``, so that a run that was cut short goes on; it is removed at the end.
    bundle : Bundle, optional
        Where it is known; by default it is found in the frames.
    dof : int, optional
        2 where frames are only shifted, 4 where they turn and grow as well; by default as the frames ask for.
    window : int, optional
        How many frames stand behind each; by default as the motion asks for, 9 to 31.
    stabilised : bool
        Whether the scene stands still and the frames move over it: on the picture of the largest piece, or, where that
        has more than four times the pixels of a frame, on the part of it that most frames see, of a frame's size. By
        default frames are shown as they lie.
    regions : numpy.ndarray, optional
        (H, W) integers, 0 where there is no region: on the video's own pixels where it is stabilised, or else on those
        of the first frame of the largest piece.
    mp4 : str or Path, optional
        A video file to look at as well, in 8 bits.
    scale_bar : bool
        Whether that has a scale bar, where the size of a pixel is known.
    client : distributed.Client, optional
        Where to work; by default in this process.

    Returns
    -------
    Video

    Raises
    ------
    SettingsError
        The window is not a number of frames, or the regions do not fit.
    OutputError
        The output or the video file exists, or other work was begun in its place.
    """
    return drain(
        videoing(
            source,
            output,
            bundle=bundle,
            dof=dof,
            window=window,
            stabilised=stabilised,
            regions=regions,
            mp4=mp4,
            scale_bar=scale_bar,
            client=client,
        )
    )


def videoing(
    source: FrameSource,
    output: str | Path,
    *,
    bundle: Bundle | None,
    dof: int | None,
    window: int | None,
    stabilised: bool,
    regions: NDArray[np.integer] | None,
    mp4: str | Path | None,
    scale_bar: bool,
    client: Any | None,
) -> Generator[Doing, None, Video]:
    """Make a video as `video` does; yields how far that is."""
    target = check_target(output, "video")
    if mp4 is not None:
        check_movie(mp4, may_replace=is_begun(work_of(target)))
    if window is not None and (not isinstance(window, int) or window < 1):
        raise SettingsError(f"window must be a number of frames, at least 1; got {window!r}")
    if regions is not None and not stabilised:
        check_regions(regions, source.shape[1:3], "a frame")
    folder = work_of(target)
    claim(
        folder,
        identity(
            source,
            bundle=bundle,
            task="video",
            dof=dof,
            window=window,
            stabilised=stabilised,
            regions=None if regions is None else sha256(np.ascontiguousarray(regions).tobytes()).hexdigest(),
        ),
    )
    with room(folder):
        own(folder, [target, poses_of(target), *traces_of(target), *([] if mp4 is None else [Path(mp4).resolve()])])
        located = yield from locating(source, folder, bundle=bundle, dof=dof, client=client)
        plan = _planned(located, target, window, stabilised, regions)
        yield from _solve(plan, located, target, client)
        made = _written(plan, located, target)
        if mp4 is not None:
            yield Doing("writing the film", left=1)
            movie = write_movie(film_source(target, source.acquisition), Path(mp4), scale_bar=scale_bar)
            made = replace(made, movie=movie)
        finish(folder)
        return made


def _solve(plan: Plan, located: Located, target: Path, client: Any | None) -> Generator[Doing, None, None]:
    work = located.work
    work.begin("frames")
    if not work.shared("frames").exists():  # frames that are solved already stay
        _create(plan, located)
        plan.save(work.shared("frames"))
    units = range(-(-len(work.source) // STRETCH))
    for _, left in complete(solve_unit, "frames", work, units, client):
        yield Doing("solving the frames", left=left, units=len(units), grown=target)


def _written(plan: Plan, located: Located, target: Path) -> Video:
    """Write the tables beside a video that is solved, and return what there is."""
    source = located.work.source
    poses, (traces, table) = poses_of(target), traces_of(target)
    write_poses(poses, plan.track, source, _pictures(plan))
    if plan.regions is not None:
        write_table(table, traces, source.acquisition.times, source.acquisition.channel_names)
    return Video(
        path=target,
        poses=poses,
        traces=traces,
        table=None if plan.regions is None else table,
        movie=None,
        track=plan.track,
        bundle=as_seen(located.work.bundle, plan.track),
        window=plan.window,
        notes=(*located.notes, *_remarks(plan)),
        quality=located.quality,
    )


def _planned(
    located: Located,
    target: Path,
    window: int | None,
    is_stabilised: bool,
    regions: NDArray[np.integer] | None,
) -> Plan:
    track, shape = located.track, located.work.bundle.shape
    width = window_for(track, located.work.bundle.pitch) if window is None else window
    picture = _canvas(track) if is_stabilised else Grid(0.0, 0.0, 1.0, shape)
    where = "the stabilised picture" if is_stabilised else "a frame"
    return Plan(
        track=track,
        path=str(target),
        traces=str(traces_of(target)[0]),
        smoothness=smoothness_for(located.traces, track, width),
        window=width,
        is_stabilised=is_stabilised,
        canvas=(picture.x0, picture.y0, *picture.shape),
        regions=None if regions is None else check_regions(regions, picture.shape, where),
    )


def _canvas(track: Track) -> Grid:
    """Return the pixels of a stabilised video: of the largest piece, or of the part of it that most frames see."""
    height, width = track.shape
    if not track.pieces:
        return Grid(0.0, 0.0, 1.0, (height, width))
    whole = picture_of(track, 0)
    rows, columns = whole.shape
    if rows * columns <= _MOST_FIELDS * height * width:
        return whole
    middle = track.corners(track.frames_of(0)).mean(axis=1)
    common = [int((np.abs(middle - own) < np.array([width, height]) / 2).all(axis=1).sum()) for own in middle]
    x, y = np.rint(middle[int(np.argmax(common))] - np.array([width - 1, height - 1]) / 2)
    return Grid(float(x), float(y), 1.0, (height, width))


def _create(plan: Plan, located: Located) -> None:
    """Make the files that stretches are written to."""
    known, template = located.work.source.acquisition, located.traces.template
    is_grey = "C" not in known.axes
    shape = (known.shape[0], *(() if is_grey else (known.shape[3],)), *plan.picture.shape)
    path = Path(plan.path)
    create_pyramid(
        path,
        shape,
        name=path.name[: -len(ENDING)],
        pixel_size=known.pixel_size,
        unit=OME_UNITS.get(known.unit or ""),
        channels=known.channel_names,
        times=known.times,
        is_video=True,
    )
    create_traces(
        Path(plan.traces),
        known.shape[0],
        template.positions.numpy(),
        known.shape[3],
        numbers_of(plan.regions),
        is_grey=is_grey,
        times=known.times,
    )


def _pictures(plan: Plan) -> Mapping[int, Grid]:
    """Return where pixels of each piece that is shown lie."""
    if plan.is_stabilised:
        return {0: plan.picture}
    return {piece: picture_of(plan.track, piece) for piece in range(plan.track.pieces)}


def _remarks(plan: Plan) -> tuple[str, ...]:
    """Return what a user should know of how frames are shown."""
    piece, notes = plan.track.piece, []
    other = int((piece > 0).sum()) if plan.is_stabilised else 0
    lost = int((piece < 0).sum())
    if other:
        notes.append(f"{other} frames lie on other pieces than the largest, and are not shown in its picture")
    if lost and plan.is_stabilised:
        notes.append(f"{lost} frames without a place are not shown")
    elif lost:
        notes.append(f"{lost} frames without a place are shown alone, smoothed")
    return tuple(notes)
