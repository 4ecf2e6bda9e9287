"""``fiberburst live``: the live view of a recording that is replayed, without napari."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.cli.work import add_overwrite, keep_input
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import OutputError, SettingsError
from napari_fiberburst.io import open_recording

if TYPE_CHECKING:
    from napari_fiberburst.live.watching import Watched


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "live",
        help="show what live view makes of a recording",
        description="Replay a recording as if it were taken now, make a picture for every frame that there is time "
        "for, and print how many a second and how late they were.",
    )
    parser.add_argument("--replay", type=Path, required=True, metavar="CLIP", help="a video, TIFF, folder or OME-Zarr")
    parser.add_argument("--fps", type=float, metavar="RATE", help="frames a second; default, the recording's own")
    parser.add_argument("--bundle", type=Path, help="probe.bundle, or an image of the bundle in even light")
    parser.add_argument("-o", "--output", type=Path, help="a film of what was shown: OUT.mp4, OUT.mkv or OUT.avi")
    add_overwrite(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Replay the recording and say how live it was."""
    # torch takes seconds to load
    from napari_fiberburst.live.calibration import frames_needed
    from napari_fiberburst.live.engine import LiveEngine
    from napari_fiberburst.live.sources import Replay
    from napari_fiberburst.live.watching import watch
    from napari_fiberburst.pipeline.reconstruct import as_bundle
    from napari_fiberburst.recordings.movie import check_movie

    target = None
    if options.output is not None:
        keep_input([options.replay], options.output)
        target = check_movie(options.output, may_replace=options.overwrite)
    recording = open_recording(options.replay)
    print(recording)
    source = Replay(recording, options.fps)
    needed = frames_needed(source.rate)
    if options.bundle is None and len(recording) < needed:
        raise SettingsError(
            f"{recording.name} has {len(recording)} frames, and calibration takes {needed} at {source.rate:g} a "
            "second; give --bundle, or a longer recording"
        )
    bundle = None if options.bundle is None else as_bundle(options.bundle)
    known = recording.acquisition
    with LiveEngine(bundle, black_level=known.black_level, white_level=known.white_level) as engine:
        if target is None:
            _tell(list(map(_without_picture, watch(source, engine))), source.rate)
            return 0
        with _Film.about(recording, target, source.rate) as film:
            _tell(list(map(film.show, watch(source, engine))), source.rate)
            film.write()
    print(f"wrote {target}")
    return 0


def _without_picture(watched: "Watched") -> "Watched":
    """Return what is told of a picture in the end, so that long replays do not keep them all in memory."""
    return replace(watched, view=replace(watched.view, image=np.empty((0, 0), np.float32)))


def _tell(shown: "list[Watched]", rate: float) -> None:
    """Print what has come of a replay."""
    dropped = sum(one.dropped for one in shown)
    first, last = shown[0], shown[-1]
    took = (last.index - first.index) / rate + last.lag
    print(f"pictures {len(shown)} in {took:.1f} s, {len(shown) / took:.1f} a second; {dropped} frames dropped")
    lags = [1000 * one.lag for one in shown if one.view.state != "calibrating"]
    if lags:
        median, late = np.percentile(lags, [50, 95])
        print(f"lag {median:.0f} ms in the median, {late:.0f} ms in the 95th percentile")
    else:
        print("note: the recording ended before calibration did; give --bundle, or a longer recording")
    print(f"at last {last.view.state}: {last.view.advice}")


class _Film:
    """Keeps the pictures in a file until the contrast of all of them can be chosen; a frame passed over shows the last.

    Parameters
    ----------
    file : Path
        To keep them in.
    recording : FrameSource
        What is replayed.
    target : Path
        The film.
    rate : float
        Its frames a second.
    """

    def __init__(self, file: Path, recording: FrameSource, target: Path, rate: float) -> None:
        self._recording, self._target, self._rate = recording, target, rate
        self._path = file
        self._file = file.open("wb")
        self._last = b""

    @classmethod
    @contextmanager
    def about(cls, recording: FrameSource, target: Path, rate: float) -> "Iterator[_Film]":
        """Keep pictures beside the target, where there is room for large files, for as long as they are needed."""
        with TemporaryDirectory(dir=target.parent, prefix=f".{target.stem}") as folder:
            film = cls(Path(folder) / "pictures", recording, target, rate)
            try:
                yield film
            finally:
                film._file.close()

    def show(self, watched: "Watched") -> "Watched":
        """Take in a picture, and return the rest."""
        try:
            for _ in range(watched.dropped):
                self._file.write(self._last)
            self._last = np.ascontiguousarray(watched.view.image, np.float32).tobytes()
            self._file.write(self._last)
        except OSError as error:
            raise OutputError(
                f"{self._target} cannot be written ({error}); pictures are kept beside it until the end, so make room "
                "there, or replay less"
            ) from error
        return _without_picture(watched)

    def write(self) -> None:
        """Write the film.

        Raises
        ------
        OutputError
            As `write_movie`.
        """
        from napari_fiberburst.recordings.movie import write_movie

        self._file.flush()
        pictures: NDArray[np.float32] = np.memmap(self._path, np.float32, "r", shape=self._recording.shape)
        source = open_recording(pictures, axes="TYXC", black_level=0, white_level=1)  # frames may be NaN
        size, unit = self._recording.acquisition.pixel_size, self._recording.acquisition.unit
        times = np.arange(len(pictures)) / self._rate
        known = replace(source.acquisition, times=times, pixel_size=size, unit=unit)
        write_movie(
            replace(source, acquisition=known, name=self._recording.name),
            self._target,
            scale_bar=True,
        )
