"""A small recording on the disk, and the mosaic that this process makes of it."""

import pytest

from napari_fiberburst.io import open_recording
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.recordings.locate import bundle_of
from napari_fiberburst.recordings.mosaic import mosaic
from napari_fiberburst.recordings.work import Work
from napari_fiberburst.simulation import simulate_recording


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
