"""What ``fiberburst info`` says of a burst or a recording."""

import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Burst
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.io import find_doubled, open_recording
from napari_fiberburst.io.frames import chosen_frames
from napari_fiberburst.io.video import find_frames
from napari_fiberburst.io.video_container import VIDEO_ENDINGS
from napari_fiberburst.pipeline.choose import best_burst
from napari_fiberburst.pipeline.glance import glance

# A recording of more frames is one that a burst is chosen from.
_LONGEST_BURST = 50
# Doubled frames are looked for among so many, and so many are named.
_SEARCHED, _NAMED = 20_000, 8
# A rate is variable where intervals differ by more than this part of the usual one, and than their rounding.
_VARIABLE, _ROUNDING = 0.01, 1.5


def facts(path: Path, axes: str | None, frames: str | None) -> Iterator[tuple[str, str]]:
    """Return what is known of a recording, names and values; what takes longest last."""
    whole = open_recording(path, axes=axes)
    numbers = chosen_frames(frames, len(whole), str(path))
    source = whole if len(numbers) == len(whole) else whole.take(numbers)
    yield from _of_frames(source)
    tick = 0.0
    if path.is_file() and path.suffix.lower() in VIDEO_ENDINGS:
        index = find_frames(path)
        tick = index.tick
        yield "codec", f"{index.codec}, {index.pixels}, {len(index.keys)} key frames"
    yield from _of_times(source.acquisition.times, tick)
    yield "doubled frames", _doubled(source)
    chosen = best_burst(source) if len(source) > _LONGEST_BURST else range(len(source))
    burst = source.burst(chosen)
    yield from _of_burst(burst)
    if len(chosen) < len(source):
        part = numbers[chosen.start : chosen.stop]
        words = ["fiberburst", "reconstruct", str(path), "--frames", _slice(part), "-o", "image.ome.tif"]
        yield "a good burst", shlex.join(words + (["--axes", axes] if axes else []))


def _of_frames(source: FrameSource) -> Iterator[tuple[str, str]]:
    known = source.acquisition
    count, height, width, channels = known.shape
    size = "unknown"
    if known.pixel_size is not None:
        size = " x ".join(f"{side:g}" for side in known.pixel_size) + f" {known.unit or '(unit unknown)'}"
    whole = 4 * np.prod(known.shape, dtype=float)
    yield "frames", str(count)
    yield "height x width", f"{height} x {width}"
    yield "channels", f"{channels} {', '.join(known.channel_names)}".strip()
    yield "pixels", f"{known.dtype}, {known.nbytes / 2**20:.1f} MiB; {whole / 2**20:.1f} MiB in memory"
    yield "levels", f"black {known.black_level:g}, white {known.white_level:g}"
    yield "pixel size", size


def _of_times(times: NDArray[np.float64] | None, tick: float) -> Iterator[tuple[str, str]]:
    if times is None:
        yield "times", "unknown"
        return
    yield "times", f"{times[0]:g} to {times[-1]:g} s"
    if len(times) > 1:
        intervals = np.diff(times)
        usual = float(np.median(intervals))
        differ = np.ptp(intervals) > max(_VARIABLE * usual, _ROUNDING * tick)
        # Rounded times are told apart from the rate by their mean alone.
        rate = 1 / (usual if differ else float(intervals.mean()))
        yield "rate", f"{rate:.4g} frames a second{', variable' if differ else ''}"
        yield "length", f"{times[-1] - times[0] + usual:.4g} s"


def _doubled(source: FrameSource) -> str:
    searched = source if len(source) <= _SEARCHED else source.take(range(_SEARCHED))
    found = find_doubled(searched).tolist()
    among = "" if searched is source else f" of the first {_SEARCHED}"
    named = ", ".join(map(str, found[:_NAMED])) + (" ..." if len(found) > _NAMED else "")
    return f"{len(found)}{among}: {named}" if found else f"none{among}"


def _of_burst(burst: Burst) -> Iterator[tuple[str, str]]:
    seen = glance(burst)
    yield "brightest", f"{burst.frames.max() * (burst.white_level - burst.black_level) + burst.black_level:g}"
    yield "shows", seen.words
    for warning in seen.warnings:
        yield "note", warning


def _slice(part: range) -> str:
    """Return a range as `--frames` takes it."""
    stop = str(part.stop) if part.stop >= 0 else ""
    return f"{part.start}:{stop}" + (f":{part.step}" if part.step != 1 else "")
