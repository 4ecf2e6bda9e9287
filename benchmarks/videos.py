"""What videos of recordings reach, beside `reconstruct` of the same windows and the truth of what blinks.

    python -m benchmarks.videos
    python -m benchmarks.videos --side 256 --frames 120 --seeds 1 2
    python -m benchmarks.videos --frames 240 --workers 2        # in processes beside this one, which are there before

A hand-held recording with cells that flash for three frames becomes a video of windows of 15 frames, in this process or
on workers.
Beside the truth of single frames stand the video's frames and what `reconstruct` makes of the same 15 frames, drawn as
the middle one sees them, after one gain and offset, where both are known, a rim of two pitches left out. Both have the
bundle as a burst of the recording calibrates it. Times are per frame, all of the video's work but that calibration in
them, and in parts of what `reconstruct` takes of a window in the same run.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from napari_fiberburst import open_recording, reconstruct, video
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.quality import psnr
from napari_fiberburst.recordings.cluster import workers
from napari_fiberburst.simulation import SimulatedRecording, simulate_recording

WINDOW, STEP, PITCH = 15, 2.5, 4.7
# Frames that are looked at, spread over the recording.
LOOKED_AT = 5


def main() -> None:
    """Measure and print, a row a recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=256, help="of the frames, pixels")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--cells", type=int, default=12, help="that flash for three frames")
    parser.add_argument("--workers", type=int, help="processes that work; by default this one does")
    options = parser.parse_args()
    print("| seed | video | `reconstruct` | worst frame | ms a frame | a window by `reconstruct` | light kept |")
    print("|---|---|---|---|---|---|---|")
    for seed in options.seeds:
        print(f"| {seed} | {row(seed, options)} |", flush=True)


def row(seed: int, options: Any) -> str:
    """Return what is measured of one recording."""
    recording = simulate_recording(
        frames=options.frames,
        shape=(options.side, options.side),
        pitch=PITCH,
        path="handheld",
        step=STEP,
        cells=options.cells,
        seed=seed,
    )
    with tempfile.TemporaryDirectory() as folder:
        source = open_recording(write_video(recording.source, Path(folder, "clip.mkv")))
        bundle = reconstruct(source.burst(range(2 * WINDOW))).bundle
        with workers(options.workers, None, source.shape) as client:
            began = time.perf_counter()
            made = video(source, Path(folder, "clean.ome.zarr"), window=WINDOW, bundle=bundle, client=client)
            a_frame = (time.perf_counter() - began) / len(source)
        frames = np.asarray(zarr.open_array(made.path / "0", mode="r"), np.float32)
    spread = np.linspace(WINDOW, len(source) - 1 - WINDOW, LOOKED_AT).round().astype(int).tolist()
    ours: list[float] = []
    theirs: list[float] = []
    took: list[float] = []
    for number in spread:
        window = np.arange(number - WINDOW // 2, number + WINDOW // 2 + 1)
        began = time.perf_counter()
        result = reconstruct(source.burst(window.tolist()), bundle=bundle)
        took.append(time.perf_counter() - began)
        pictures = frames[number], result.frame(WINDOW // 2)
        known = np.isfinite(np.stack(pictures)).all(axis=0)
        for picture, found in zip(pictures, (ours, theirs), strict=True):
            found.append(quality(picture, known, recording, number))
    gaps = np.subtract(ours, theirs)
    cells = (
        f"{np.mean(ours):.1f} dB",
        f"{np.mean(theirs):.1f} dB",
        f"{gaps.min():+.1f} dB",
        f"{1e3 * a_frame:.0f}",
        f"{np.mean(took) / a_frame:.0f} x",
        f"{100 * light_kept(frames, recording):.0f} %",
    )
    return " | ".join(cells)


def quality(image: NDArray[np.floating], known: NDArray[np.bool_], recording: SimulatedRecording, number: int) -> float:
    """Return the PSNR of a frame against what it looked at, where both pictures are known, dB."""
    rim = round(2 * PITCH)
    inside = np.zeros_like(known)
    inside[rim:-rim, rim:-rim] = known[rim:-rim, rim:-rim]
    return psnr(image[inside], recording.truth([number])[0, ..., 0][inside])


def light_kept(frames: NDArray[np.floating], recording: SimulatedRecording) -> float:
    """Return which part of the light that flashes add to frames is in the video, of cells well inside the frames."""
    total = kept = 0.0
    height, width = frames.shape[1:]
    y, x = np.indices((height, width))
    scale = _gain(frames, recording)
    for cell, trace in zip(recording.cells, recording.traces.T, strict=True):
        inner = np.nonzero((trace[1:-1] > 0) & (trace[:-2] > 0) & (trace[2:] > 0))[0] + 1
        for number in map(int, inner):
            at = np.linalg.inv(recording.homographies[number]) @ [*cell, 1]
            reach = 2 * recording.cell_radius
            if not (reach + 9 < at[0] < width - reach - 9 and reach + 9 < at[1] < height - reach - 9):
                continue
            near = np.hypot(x - at[0], y - at[1]) <= reach
            dark = number - 4 if number >= 4 else number + 4
            before = np.linalg.inv(recording.homographies[dark]) @ [*cell, 1]
            there = np.hypot(x - before[0], y - before[1]) <= reach
            if trace[dark] > 0 or there.sum() < 0.9 * near.sum():
                continue
            truth = recording.truth([number, dark])[..., 0]
            total += truth[0][near].sum() - truth[1][there].mean() * near.sum()
            kept += (np.nanmean(frames[number][near]) - np.nanmean(frames[dark][there])) * near.sum() / scale
    return kept / total if total else np.nan


def _gain(frames: NDArray[np.floating], recording: SimulatedRecording) -> float:
    """Return what the video multiplies the object's light by."""
    number = len(frames) // 2
    image, truth = frames[number], recording.truth([number])[0, ..., 0]
    known = np.isfinite(image)
    return float(np.polyfit(truth[known], image[known], 1)[0])


if __name__ == "__main__":
    main()
