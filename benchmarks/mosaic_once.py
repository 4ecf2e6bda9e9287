"""Make one mosaic of a video, or one image of a burst of it, in a process of its own, for `benchmarks.recordings`.

    python -m benchmarks.mosaic_once VIDEO RESULT.json --mosaic OUT.ome.zarr [--poses TRUTH.npy]
    python -m benchmarks.mosaic_once VIDEO RESULT.json --burst FIRST LAST

The result holds `cpu` and `wall`, seconds without imports; `peak`, the most bytes that the process has had, imports
included, because a machine has to hold them too; and `frames`. The track is written beside the mosaic. With the true
places of frames (T, 3, 3), the scene is solved once more at those, after the measurement, as ``true.ome.zarr``; gains,
exposures and smoothness are those that were found.
"""

import argparse
import json
import shutil
import time
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.fit_once import most_memory
from napari_fiberburst import open_recording, reconstruct
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.recordings import mosaic as mosaics
from napari_fiberburst.recordings.locate import Located, locating
from napari_fiberburst.recordings.work import Doing

# The burst is reconstructed so many times after once for nothing, and the least time counts.
_REPEATS = 2


def main() -> None:
    """Measure, and write what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("--mosaic", type=Path)
    parser.add_argument("--poses", type=Path)
    parser.add_argument("--burst", type=int, nargs=2, default=(0, 20))
    options = parser.parse_args()
    source = open_recording(options.video)
    if options.mosaic is None:
        found = of_burst(source, *options.burst)
    else:
        poses = None if options.poses is None else np.load(options.poses)
        found = of_mosaic(source, options.mosaic, poses)
    options.result.write_text(json.dumps({"frames": len(source), **found}), encoding="utf-8")


def of_burst(source: FrameSource, first: int, last: int) -> dict[str, Any]:
    """Return what a reconstruction of some frames in a row takes, reading included."""
    times = []
    for _ in range(1 + _REPEATS):
        cpu, wall = time.process_time(), time.perf_counter()
        reconstruct(source.burst(range(first, last)))
        times.append((time.process_time() - cpu, time.perf_counter() - wall))
    cpus, walls = zip(*times[1:], strict=True)
    return {"cpu": min(cpus), "wall": min(walls), "peak": most_memory()}


def of_mosaic(source: FrameSource, output: Path, poses: NDArray[np.float64] | None) -> dict[str, Any]:
    """Return what a mosaic takes, and make it once more with the true places."""
    kept: list[Located] = []
    copied = output.with_name("kept")

    def keeping(*given: Any, **named: Any) -> Generator[Doing, None, Located]:
        located = yield from locating(*given, **named)
        kept.append(located)
        if poses is not None:
            shutil.copytree(located.work.folder, copied)
        return located

    cpu, wall = time.process_time(), time.perf_counter()
    with patch.object(mosaics, "locating", keeping):
        made = mosaics.mosaic(source, output)
    found = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall, "peak": most_memory()}
    made.track.save(output.with_name("track.safetensors"))
    if poses is not None:
        track = replace(made.track, scene_from_frame=poses, control=None)
        true = replace(kept[0], work=replace(kept[0].work, folder=copied), track=track)
        with patch.object(mosaics, "locating", lambda *given, **named: _at_once(true)):
            mosaics.mosaic(source, output.with_name("true.ome.zarr"))
        shutil.rmtree(copied)
    pieces = [int((made.track.piece == piece).sum()) for piece in range(made.track.pieces)]
    return {**found, "pieces": pieces, "dof": made.track.dof, "resolution": made.resolution, "notes": made.notes}


def _at_once(located: Located) -> Generator[Doing, None, Located]:
    yield Doing("locating")
    return located


if __name__ == "__main__":
    main()
