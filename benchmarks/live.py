"""Live view on simulated recordings: how fast, how late, and how good beside `reconstruct` of the last frames.

    python -m benchmarks.live                    # 256 x 256, two seeds, two levels of noise; some minutes
    python -m benchmarks.live --side 512

A hand-held recording of grey frames with a pitch of 5 pixels is pushed frame by frame as fast as it goes (rate, PSNR of
the last picture), and replayed at 30 frames a second on the machine's clock (lag, dropped frames). `reconstruct` gets
the last 20 frames and the same bundle; PSNR is that of frame-wide pictures less a rim, after one gain and offset.
"""

import argparse
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst import Bundle, Burst, LiveEngine, open_recording, reconstruct
from napari_fiberburst.live.sources import Replay
from napari_fiberburst.live.watching import watch
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, SimulatedRecording, simulate_recording

# Electrons at full scale, and noise in the dark.
CAMERAS = {"bright": Camera(), "dim": Camera(photons=300, read_noise=0.01)}
PITCH, STEP, RATE = 5.0, 3.0, 30.0
FRAMES, LAST = 60, 20
# Frames that an engine takes to begin with, and pixels at the rim, that are left out.
BEGUN, RIM = 5, 12


def main() -> None:
    """Measure and print, a row a recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=256, help="of the frames, pixels")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    print("| seed | camera | cores | pictures a second | lag p50 | lag p95 | dropped | PSNR live | `reconstruct` |")
    print("|---|---|---|---|---|---|---|---|---|")
    for seed in options.seeds:
        for name, camera in CAMERAS.items():
            print(f"| {seed} | {name} | {row(seed, camera, options.side)} |", flush=True)


def row(seed: int, camera: Camera, side: int) -> str:
    """Return what is measured of one recording."""
    recording = simulate_recording(
        frames=FRAMES, shape=(side, side), pitch=PITCH, path="handheld", step=STEP, camera=camera, seed=seed
    )
    bundle = Bundle.from_image(np.rint(np.clip(recording.transmission * 255, 0, 255)).astype(np.uint8))
    frames = recording.source.recorded(range(FRAMES))[..., 0]
    engine, took = LiveEngine(bundle), []
    for frame in frames:
        start = time.perf_counter()
        view = engine.push(frame)
        took.append(time.perf_counter() - start)
    watched = list(watch(Replay(open_recording(frames), RATE), LiveEngine(bundle)))
    median, late = np.percentile([1000 * one.lag for one in watched[BEGUN:]], [50, 95])
    whole = reconstruct(Burst(frames[-LAST:]), bundle=bundle)
    cells = (
        f"{len(bundle.centres)}",
        f"{1 / np.mean(took[BEGUN:]):.0f}",
        f"{median:.0f} ms",
        f"{late:.0f} ms",
        f"{sum(one.dropped for one in watched)} of {FRAMES}",
        f"{quality(view.image, recording, FRAMES - 1):.1f} dB",
        f"{quality(whole.image, recording, FRAMES - LAST + whole.reference):.1f} dB",
    )
    return " | ".join(cells)


def quality(image: NDArray[np.floating[Any]], recording: SimulatedRecording, number: int) -> float:
    """Return the PSNR of a picture over the pixels of a frame, dB."""
    inner = (slice(RIM, -RIM), slice(RIM, -RIM))
    return psnr(image[inner], recording.truth([number])[0][..., 0][inner])


if __name__ == "__main__":
    main()
