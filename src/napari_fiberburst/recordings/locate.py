"""Where every frame of a recording lies: calibrate the bundle, trace its cores, register the frames, refine them."""

from collections.abc import Generator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.calibrate import calibrating, remark
from napari_fiberburst.bundle.field import find_marks
from napari_fiberburst.bundle.mount import find_mount
from napari_fiberburst.bundle.placement import find_bundle
from napari_fiberburst.bundle.samples import in_grey, only_exposed
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.recordings.links import Links
from napari_fiberburst.recordings.poses import Poses, solve_poses
from napari_fiberburst.recordings.rectify import rectified
from napari_fiberburst.recordings.refine import (
    Refinement,
    ask_to_bend,
    bending,
    larger_model,
    refine_unit,
    refine_units,
    refined,
)
from napari_fiberburst.recordings.register import registering
from napari_fiberburst.recordings.traces import Traces, tracing
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.views import middle_of
from napari_fiberburst.recordings.work import Doing, Work, complete
from napari_fiberburst.scene.shading import find_shading
from napari_fiberburst.steps import drain
from napari_fiberburst.stored import Stored

# The bundle is calibrated from so many frames, spread over the recording.
_CALIBRATED_FROM = 48
# Scene and frames are found in turn so many times at least, and as long as that lowers the error by a part of it. Until
# then, what is wrong with gains, exposures and long waves would ask for more freedom, too.
_ROUNDS, _MOST_ROUNDS, _WORTH = 3, 20, 0.985
# A scene that was rectified and then misses more than before by this part was not strained.
_WORSE = 1.01
# Frames bend where that lowers the error by a part of it.
_WORTH_BENDING = 0.9
# Frames of which the scene misses so many times the usual show something else, or are blurred.
_MOST_MISSED = 4.0
# Places are doubtful where more than this part of the frames has none, or the median frame is less like the scene.
_MOST_LOST, _LEAST_ALIKE = 0.25, 0.93
# Degrees of freedom of links: frames of fewer are placed anew where they turn.
_TURNING = 4
# The slow changes of the illumination are told by so many frames, spread over the recording.
_SHADED_FROM = 60
# Where the frames have seen so many times their own field, the mean of what a core has seen is its gain; on a shorter
# path the object is in it.
_WIDE = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Located:
    """A recording whose frames have their places.

    Attributes
    ----------
    work : Work
        With the bundle, and the traces.
    traces : Traces
        What the cores have seen.
    track : Track
        Where the frames lie.
    notes : tuple of str
        What a user should know.
    quality : str
        "good", or "doubtful" where the notes say why the places of frames may be wrong.
    """

    work: Work
    traces: Traces
    track: Track
    notes: tuple[str, ...]
    quality: Literal["good", "doubtful"]


def locating(
    source: FrameSource, folder: Path, *, bundle: Bundle | None, dof: int | None, client: Any | None
) -> Generator[Doing, None, Located]:
    """Find the place of every frame; yields how far that is.

    Parameters
    ----------
    source : FrameSource
        The recording.
    folder : Path
        For what is found on the way; work that was begun there goes on.
    bundle : Bundle, optional
        Where it is known.
    dof : int, optional
        2 for shifts alone, 4 for turns and zoom as well; by default as the frames ask for.
    client : distributed.Client, optional
        Where to work; by default in this process.
    """
    yield Doing("calibrating the bundle", left=1)
    bundle, notes = _kept_bundle(source, bundle, folder / "bundle.safetensors")
    work = Work(source=source, bundle=bundle, folder=folder)
    traces = yield from tracing(work, client)
    links, poses = yield from registering(work, dof, client)
    track = _first_track(work, traces, poses)
    track = yield from _refining(work, traces, links, track, is_free=dof is None, client=client)
    doubts = _doubts(traces, track)
    return Located(
        work=work,
        traces=traces,
        track=track,
        notes=(*notes, *_remarks(traces, track), *doubts),
        quality="doubtful" if doubts else "good",
    )


def _refining(
    work: Work, traces: Traces, links: Links, track: Track, *, is_free: bool, client: Any | None
) -> Generator[Doing, None, Track]:
    """Refine a track until that lowers its error no more; `is_free`, with as much freedom as the frames ask for.

    Frames may bend where that is worth it: it is tried where they ask for stretches.
    """
    settled, unbent = 0, None
    unrectified, is_rectified = track, True
    for number in range(_MOST_ROUNDS):
        stage, before = f"refined-{number}", track
        work.begin(stage)
        track.save(work.shared(stage))
        units = refine_units(track)
        for _, left in complete(refine_unit, stage, work, units, client):
            yield Doing("refining", number, _MOST_ROUNDS, left, len(units))
        parts = [Refinement.load(work.path(stage, unit)) for unit in units]
        stepped, settled = refined(track, parts), settled + 1
        if settled > 1 and is_rectified and stepped.error > _WORSE * before.error:
            # What frames tell is not the scene's: a fixed pattern strains them all alike, or they bend.
            track, is_rectified = unrectified, False
            continue
        if number == 0 and len(stepped.frames_of(0)) and not work.bundle.gains_known:
            stepped = _evened(traces, stepped)
        unrectified, track = stepped, rectified(stepped, parts) if is_rectified else stepped
        if settled < _ROUNDS or track.error < _WORTH * before.error:
            continue
        asked = larger_model(track, parts) if is_free else track.dof
        if asked > track.dof:
            track, settled = _with_freedom(work, track, links, asked), 0
        elif is_free and unbent is None and ask_to_bend(parts):
            unbent, track, settled = track, bending(track), 0
        else:
            break
    if unbent is not None and track.error > _WORTH_BENDING * unbent.error:
        track = unbent
    # The weight of a frame falls with the square of what the scene misses of it.
    belongs = track.weights > 1 / _MOST_MISSED**2
    return replace(track, piece=np.where(belongs, track.piece, -1)).anchored()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found(Stored):
    """A bundle as it was found, so that work that goes on does so with the same one."""

    _kind: ClassVar[str] = "bundle in a recording"

    bundle: Bundle
    notes: tuple[str, ...]


def _kept_bundle(source: FrameSource, given: Bundle | None, path: Path) -> tuple[Bundle, tuple[str, ...]]:
    if not path.exists():
        bundle, notes = bundle_of(source, given)
        _Found(bundle=bundle, notes=notes).save(path)
    found = _Found.load(path)
    return found.bundle, found.notes


def bundle_of(source: FrameSource, given: Bundle | None) -> tuple[Bundle, tuple[str, ...]]:
    """Return the bundle of a recording, and what a user should know of it: found in the frames, or found again."""
    numbers = np.unique(np.linspace(0, len(source) - 1, _CALIBRATED_FROM).astype(int)).tolist()
    grey = in_grey(torch.from_numpy(source.values(numbers)))
    marks = find_marks(only_exposed(grey))
    notes = []
    if given is None:
        bundle = drain(calibrating(grey, source.acquisition, marks))
        notes.append(remark(bundle))
    else:
        placement = find_bundle(given, grey, source.acquisition)
        bundle = placement.bundle.masked(marks.numpy())
        notes.append(placement.note)
    mount = find_mount(grey)
    if mount is not None:
        far = float(np.abs(mount.offsets).max())
        notes.append(f"the bundle moves on the camera by up to {far:.1f} px, which is not followed; mount it firmly")
    return bundle, tuple(note for note in notes if note)


def _first_track(work: Work, traces: Traces, poses: Poses) -> Track:
    shape, pitch = work.bundle.shape, work.bundle.pitch
    count, channels = len(traces), traces.template.values.shape[2]
    track = Track(
        scene_from_frame=poses.matrices(middle_of(shape, pitch)),
        piece=poses.piece,
        exposures=np.ones(count, np.float32),
        gains=np.ones((len(work.bundle.centres), channels), np.float32),
        weights=np.ones(count, np.float32),
        alike=np.full(count, np.nan),
        error=float("nan"),
        shape=shape,
        dof=poses.dof,
        gain_weights=np.zeros(len(work.bundle.centres), np.float32),
    )
    x0, y0, x1, y1 = track.bounds(0) if track.pieces else (0.0, 0.0, 0.0, 0.0)
    if work.bundle.gains_known or (x1 - x0) * (y1 - y0) < _WIDE * shape[0] * shape[1]:
        return track
    mean = traces.summary.mean_light.numpy()
    gains = np.where(mean > 0, mean / np.median(mean[mean > 0]), 1).astype(np.float32)
    return replace(track, gains=np.repeat(gains[:, None], channels, axis=1))


def _with_freedom(work: Work, track: Track, links: Links, dof: int) -> Track:
    """Return the track with more freedom; where frames may turn, from poses that let them."""
    if dof > _TURNING:
        return replace(track, dof=dof)
    poses = solve_poses(links, len(track), dof)
    matrices = poses.matrices(middle_of(track.shape, work.bundle.pitch))
    return replace(track, scene_from_frame=matrices, piece=poses.piece, dof=dof)


def _evened(traces: Traces, track: Track) -> Track:
    """Return the track with the slow changes of the illumination in its gains.

    Scene and gains follow one another where those change slowly over the frame, so that finding them in turn takes many
    rounds. Some frames of the largest piece tell them at once.
    """
    frames = track.spread(track.frames_of(0), _SHADED_FROM, traces.template.pitch)
    samples = traces.samples(frames).without_gains(torch.from_numpy(track.gains))
    registration = Registration.known(track.scene_from_frame[frames], track.shape, samples.cores)
    shading = find_shading(samples, replace(registration, exposures=track.exposures[frames]))
    if shading is None:
        return track
    gains = track.gains * shading.gains.numpy()
    # The frames between those that were asked have the exposures of these.
    change = np.interp(np.arange(len(track)), frames, shading.exposures.numpy()).astype(np.float32)
    exposures = np.where(track.piece == 0, track.exposures * change, track.exposures)
    return replace(track, gains=gains, exposures=exposures)


def _doubts(traces: Traces, track: Track) -> tuple[str, ...]:
    """Return why the places of frames may be wrong."""
    shows, placed = traces.summary.shows, track.piece >= 0
    if not placed.any():
        return ("no two frames show the same place",)
    doubts = []
    lost = float((shows & ~placed).sum() / max(1, shows.sum()))
    if lost > _MOST_LOST:
        doubts.append(f"{lost:.0%} of the frames that show something could not be placed")
    alike = float(np.median(track.alike[placed]))
    if alike < _LEAST_ALIKE:
        doubts.append(f"frames are met by the scene with a correlation of {alike:.2f} alone; their places may be wrong")
    return tuple(doubts)


def _remarks(traces: Traces, track: Track) -> tuple[str, ...]:
    """Return what a user should know of where the frames lie."""
    notes = []
    blank = int((~traces.summary.shows).sum())
    lost = int((traces.summary.shows & (track.piece < 0)).sum())
    if blank:
        notes.append(f"{blank} of {len(track)} frames show nothing and were left out")
    if lost:
        notes.append(f"{lost} of {len(track)} frames could not be placed and were left out")
    if track.pieces > 1:
        notes.append(f"contact was lost or the scene has jumped: the frames make {track.pieces} pieces")
    return tuple(notes)
