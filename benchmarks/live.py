"""Live view on simulated recordings: how fast, how late, and how good beside `reconstruct` of the last frames.

    python -m benchmarks.live                    # 256 x 256, two seeds, two levels of noise; some minutes
    python -m benchmarks.live --side 512
    python -m benchmarks.live --side 1024 --pitch 6.5 --seeds 1
    python -m benchmarks.live --drift 1000       # how far places drift
    python -m benchmarks.live --hour 100000      # how memory grows over as many frames as an hour has

A hand-held recording of grey frames is pushed frame by frame as fast as it goes (first picture, rate, PSNR of the last
picture), and replayed at 30 frames a second on the machine's clock (lag, dropped frames; once more without a bundle,
for how long its first picture takes). `reconstruct` gets the last 20 frames and the same bundle; PyFibreBundle, where
it is installed, interpolates between the cores of one frame at a time, with the true layout and transmission. PSNR is
that of frame-wide pictures less a rim, after one gain and offset.
"""

import argparse
import time
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from benchmarks.methods import PeerError, fibrebundle
from napari_fiberburst import Bundle, Burst, LiveEngine, open_recording, reconstruct
from napari_fiberburst.live.sources import Replay
from napari_fiberburst.live.watching import watch
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, SimulatedRecording, simulate_recording

# Electrons at full scale, and noise in the dark.
CAMERAS = {"bright": Camera(), "dim": Camera(photons=300, read_noise=0.01)}
STEP, RATE = 3.0, 30.0
FRAMES, LAST = 150, 20
# Frames that an engine takes to begin with, and pixels at the rim, that are left out.
BEGUN, RIM = 5, 12
# Pixels from frame to frame where drift is measured: few enough that the path stays within two fields.
SLOW_STEP = 2.0
# Frames that go by there and back, again and again, in an hour.
LOOP = 200
COLUMNS = ["seed", "camera", "cores", "first picture", "without a bundle", "pictures a second", "picture p95"]
COLUMNS += ["lag p50", "lag p95", "dropped", "PSNR live", "`reconstruct`", "PyFibreBundle, one frame"]
DRIFT_COLUMNS = ["seed", "fields", "drift at most", "after all"]
HOUR_COLUMNS = ["seed", "frames", "memory after a tenth", "after half", "after all", "drift at most", "pieces"]


def main() -> None:
    """Measure and print, a row a recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=256, help="of the frames, pixels")
    parser.add_argument("--pitch", type=float, default=5.0, help="of the cores, pixels")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--drift", type=int, metavar="FRAMES", help="measure drift over so many frames instead")
    parser.add_argument("--hour", type=int, metavar="FRAMES", help="measure memory over so many frames instead")
    options = parser.parse_args()
    for frames, columns, measure in ((options.drift, DRIFT_COLUMNS, drift), (options.hour, HOUR_COLUMNS, hour)):
        if frames:
            _head(columns)
            for seed in options.seeds:
                print(f"| {seed} | {measure(seed, options.side, options.pitch, frames)} |", flush=True)
            return
    _head(COLUMNS)
    for seed in options.seeds:
        for name, camera in CAMERAS.items():
            print(f"| {seed} | {name} | {row(seed, camera, options.side, options.pitch)} |", flush=True)


def _head(columns: list[str]) -> None:
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")


def row(seed: int, camera: Camera, side: int, pitch: float) -> str:
    """Return what is measured of one recording."""
    recording = simulate_recording(
        frames=FRAMES, shape=(side, side), pitch=pitch, path="handheld", step=STEP, camera=camera, seed=seed
    )
    bundle = bundle_of(recording)
    frames = recording.source.recorded(range(FRAMES))[..., 0]
    engine, took = LiveEngine(bundle), []
    for frame in frames:
        start = time.perf_counter()
        view = engine.push(frame)
        took.append(time.perf_counter() - start)
    engine.close()  # or else its gains are still measured on while the replay runs
    with LiveEngine(bundle) as engine:
        watched = list(watch(Replay(open_recording(frames), RATE), engine))
    median, late = np.percentile([1000 * one.lag for one in watched[BEGUN:]], [50, 95])
    whole = reconstruct(Burst(frames[-LAST:]), bundle=bundle)
    cells = (
        f"{len(bundle.centres)}",
        f"{took[0]:.2f} s",
        f"{_first_without_a_bundle(frames):.1f} s",
        f"{1 / np.mean(took[BEGUN:]):.0f}",
        f"{1000 * np.percentile(took[BEGUN:], 95):.0f} ms",
        f"{median:.0f} ms",
        f"{late:.0f} ms",
        f"{sum(one.dropped for one in watched)} of {FRAMES}",
        f"{quality(view.image, recording, FRAMES - 1):.1f} dB",
        f"{quality(whole.image, recording, FRAMES - LAST + whole.reference):.1f} dB",
        peer(recording, frames, pitch),
    )
    return " | ".join(cells)


def peer(recording: SimulatedRecording, frames: NDArray[Any], pitch: float) -> str:
    """Return how fast PyFibreBundle interpolates between the cores of frames, and how good its last image is."""
    try:
        image, seconds = fibrebundle(
            "live",
            frames=frames[..., None] / np.float32(255),
            bundle=recording.transmission,
            centres=recording.bundle.centres,
            pitch=pitch,
            x=0.0,
            y=0.0,
            size=frames.shape[1],
            grid=frames.shape[1],
        )
    except PeerError as error:
        return str(error)
    return f"{1 / seconds:.0f} a second, {quality(image[..., 0], recording, len(frames) - 1):.1f} dB"


def drift(seed: int, side: int, pitch: float, count: int) -> str:
    """Return how far places drift while a hand comes back again and again, from what they are early on."""
    recording, middle = _slow_hand(seed, side, pitch, count)
    true = recording.homographies
    engine, off = LiveEngine(bundle_of(recording)), []
    for number in range(count):
        view = engine.push(recording.source.recorded([number])[0, ..., 0])
        off.append(((view.homography - true[number]) @ middle)[:2])
    moved = np.linalg.norm(off[LAST:] - np.mean(off[LAST : 2 * LAST], axis=0), axis=1)
    fields = 1 + np.ptp(true[:, :2, 2], axis=0) / side
    cells = (
        f"{fields[0]:.1f} x {fields[1]:.1f}",
        f"{moved.max():.2f} px",
        f"{moved[-LAST:].mean():.2f} px",
    )
    return " | ".join(cells)


def hour(seed: int, side: int, pitch: float, count: int) -> str:
    """Return how much memory the process has while frames are pushed, 30 a second on a simulated clock."""
    recording, middle = _slow_hand(seed, side, pitch, LOOP)
    frames, true = recording.source.recorded(range(LOOP))[..., 0], recording.homographies
    engine, process = LiveEngine(bundle_of(recording)), psutil.Process()
    memory, off = np.zeros(count), np.zeros(count)
    for number in range(count):
        turn = number % (2 * LOOP - 2)
        at = min(turn, 2 * LOOP - 2 - turn)
        view = engine.push(frames[at], number / RATE)
        off[number] = np.hypot(*((view.homography - true[at]) @ middle)[:2])
        memory[number] = process.memory_info().rss / 2**20
    cells = (
        f"{count}",
        *(f"{memory[int(part * count) - 1]:.0f} MiB" for part in (0.1, 0.5, 1.0)),
        f"{off.max():.2f} px",
        f"{view.piece + 1}",
    )
    return " | ".join(cells)


def _slow_hand(seed: int, side: int, pitch: float, count: int) -> tuple[SimulatedRecording, NDArray[np.float64]]:
    """Return a recording of so many frames, and the middle of a frame, (3,)."""
    recording = simulate_recording(
        frames=count, shape=(side, side), pitch=pitch, path="handheld", step=SLOW_STEP, seed=seed
    )
    return recording, np.array([(side - 1) / 2, (side - 1) / 2, 1])


def _first_without_a_bundle(frames: NDArray[Any]) -> float:
    """Return how many seconds after the first frame of a replay there is a picture by a bundle that was measured."""
    there_and_back = np.concatenate([frames, frames[::-1]])
    with LiveEngine() as engine:
        source = Replay(open_recording(there_and_back), RATE)
        start = source.clock.now()
        for one in watch(source, engine):
            if one.view.state == "following":
                return source.clock.now() - start
    return float("nan")


def bundle_of(recording: SimulatedRecording) -> Bundle:
    """Return the bundle as an image in even light has it."""
    return Bundle.from_image(np.rint(np.clip(recording.transmission * 255, 0, 255)).astype(np.uint8))


def quality(image: NDArray[np.floating[Any]], recording: SimulatedRecording, number: int) -> float:
    """Return the PSNR of a picture over the pixels of a frame, dB."""
    inner = (slice(RIM, -RIM), slice(RIM, -RIM))
    return psnr(image[inner], recording.truth([number])[0][..., 0][inner])


if __name__ == "__main__":
    main()
