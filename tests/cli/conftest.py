"""A recording, and its command stopped, which tests of several commands share."""

import pytest

from napari_fiberburst.cli import main
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.recordings import mosaic as mosaics
from napari_fiberburst.simulation import simulate_recording


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    """Return a recording of 12 frames of 71 x 89 pixels."""
    path = tmp_path_factory.mktemp("recording") / "clip.mkv"
    write_video(simulate_recording(path="raster", shape=(71, 89), frames=12, seed=1).source, path)
    return path


@pytest.fixture
def stop_drawing(monkeypatch):
    """Return a function that gives the words of a mosaic, and stops it once it draws."""

    def stop(*given):
        raise KeyboardInterrupt

    def stopped(words):
        with monkeypatch.context() as patched:
            patched.setattr(mosaics, "draw_unit", stop)
            with pytest.raises(SystemExit):
                main(words)

    return stopped
