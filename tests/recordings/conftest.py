"""Recordings that the tests share, and what has been found in them. Sides are odd and unequal."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from napari_fiberburst.io import open_recording
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.recordings.links import Linker
from napari_fiberburst.recordings.locate import bundle_of, locating
from napari_fiberburst.recordings.mosaic import mosaic
from napari_fiberburst.recordings.outputs import identity
from napari_fiberburst.recordings.refine import Refinement, refine_unit, refine_units, refined
from napari_fiberburst.recordings.traces import traced, tracing
from napari_fiberburst.recordings.views import Views, middle_of
from napari_fiberburst.recordings.work import Work, claim
from napari_fiberburst.simulation import simulate_recording
from napari_fiberburst.steps import drain

SHAPE = (97, 121)
# Where pairs of frames are to be laid on one another by themselves, they need enough to see.
WIDE = (161, 187)


@pytest.fixture(scope="session")
def hand():
    """Return 64 frames of a hand that loses contact once, and a cut."""
    return simulate_recording(
        frames=64, shape=SHAPE, path="handheld", gaps=1, gap_frames=6, jumps=1, flicker=0.05, seed=3
    )


@pytest.fixture(scope="session")
def hand_located(hand, tmp_path_factory):
    """Return where the hand's frames lie, and the folder of a mosaic that was begun with it."""
    output = tmp_path_factory.mktemp("hand") / "wide.ome.zarr"
    folder = output.with_name("wide.work")
    claim(folder, identity(hand.source, bundle=None, task="mosaic", dof=None))
    located = drain(locating(hand.source, folder, bundle=None, dof=None, client=None))
    kept = folder.with_name("kept")
    shutil.copytree(folder, kept)
    return replace(located, work=replace(located.work, folder=kept)), output


@pytest.fixture(scope="session")
def located(hand_located):
    """Return where the hand's frames lie."""
    return hand_located[0]


@pytest.fixture(scope="session")
def made(hand, hand_located):
    """Return the mosaic of the hand's recording, which goes on from where its frames lie."""
    return mosaic(hand.source, hand_located[1])


class Turning:
    """A recording of a hand that turns, its traces, and a linker of its frames."""

    def __init__(self, folder):
        self.truth = simulate_recording(frames=120, shape=WIDE, path="handheld", turn=3.0, zoom=0.02, step=4.0, seed=5)
        work = Work(source=self.truth.source, bundle=bundle_of(self.truth.source, None)[0], folder=folder)
        drain(tracing(work, None))
        self.traces = traced(work)
        self.linker = Linker(Views(self.traces))
        self.middle = middle_of(WIDE, self.traces.template.pitch)

    def similarity(self, first, second):
        """Return how the second frame truly lies on the first, as those of `Links`."""
        between = np.linalg.inv(self.truth.homographies[first]) @ self.truth.homographies[second]
        at = between @ [*self.middle, 1]
        return np.array([between[0, 0], between[1, 0], *(at[:2] - self.middle)])


@pytest.fixture(scope="session")
def turning(tmp_path_factory):
    """Return a recording of a hand that turns, with a linker of its frames."""
    return Turning(tmp_path_factory.mktemp("turning"))


def refine_in_turn(work, track, rounds, name, finish=lambda track, parts: track):
    """Return a track after so many rounds of refining, each finished by a function of the track and its parts."""
    for number in range(rounds):
        stage = f"{name}-{number}"
        work.begin(stage)
        track.save(work.shared(stage))
        units = refine_units(track)
        for unit in units:
            refine_unit(work, stage, unit)
        parts = [Refinement.load(work.path(stage, unit)) for unit in units]
        track = finish(refined(track, parts), parts)
    return track


def middles(matrices):
    """Return where the middles of frames lie, as complex numbers."""
    x, y, _ = np.moveaxis(matrices @ [(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2, 1], -1, 0)
    return x + 1j * y


def after_similarity(found, true):
    """Return found places (n,) after the similarity that brings them closest to true ones, and that similarity."""
    basis = np.stack([found, np.ones_like(found)], axis=1)
    turn, shift = np.linalg.lstsq(basis, true, rcond=None)[0]
    return turn * found + shift, (turn, shift)


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    """Return the file of a recording of 40 frames of 97 x 121."""
    path = tmp_path_factory.mktemp("recording") / "clip.mkv"
    write_video(simulate_recording(path="raster", shape=(97, 121), frames=40, seed=1).source, path)
    return path


@pytest.fixture(scope="session")
def unbroken(clip, tmp_path_factory):
    """Return the folder of its mosaic, made in this process at once."""
    folder = tmp_path_factory.mktemp("unbroken")
    mosaic(open_recording(clip), folder / "m.ome.zarr")
    return folder


@pytest.fixture(scope="session")
def bundle(clip):
    """Return its bundle."""
    return bundle_of(open_recording(clip), None)[0]


@pytest.fixture
def work(clip, bundle, tmp_path):
    """Return work on the recording, in a folder of its own, with a stage called "some"."""
    folder = tmp_path / "m.work"
    folder.mkdir()
    work = Work(source=open_recording(clip), bundle=bundle, folder=folder)
    work.begin("some")
    return work
