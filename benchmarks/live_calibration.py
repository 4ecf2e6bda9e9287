"""How a live engine calibrates itself, beside `reconstruct`: how long it takes, and what that costs the picture.

    python -m benchmarks.live_calibration        # 256 x 256, four recordings; some minutes

Twenty frames of the first second calibrate. Gains are those of the cores that were found, against an image of the
bundle in even light, 1 sigma of the ratio beside its neighbours' (1.48 times the median deviation). PSNR is that of the
picture after 60 frames with each bundle.
"""

import time

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.live import RATE, bundle_of, quality
from napari_fiberburst import Bundle, Burst, LiveEngine, reconstruct
from napari_fiberburst.live.calibration import CALIBRATED_BY, measuring
from napari_fiberburst.simulation import Camera, SimulatedRecording, simulate_recording
from napari_fiberburst.steps import drain

DIM = Camera(photons=300, read_noise=0.01)
# Scene, step, seed and camera.
RECORDINGS = (
    ("slide", 2.0, 1, Camera()),
    ("fluorescence", 3.0, 2, Camera()),
    ("slide", 1.0, 3, DIM),
    ("fluorescence", 0.7, 4, Camera()),
)
FRAMES, SIDE, PITCH, NEIGHBOURS = 60, 256, 5.0, 40


def main() -> None:
    """Measure and print, a row a recording."""
    print("| scene | step | gains | `reconstruct` | seconds | `reconstruct` | PSNR | `reconstruct` | flat |")
    print("|---|---|---|---|---|---|---|---|---|")
    for scene, step, seed, camera in RECORDINGS:
        recording = simulate_recording(
            scene, frames=FRAMES, shape=(SIDE, SIDE), pitch=PITCH, path="handheld", step=step, camera=camera, seed=seed
        )
        frames = recording.source.recorded(range(FRAMES))[..., 0]
        first = Burst(frames[np.linspace(0, RATE, CALIBRATED_BY).round().astype(int)])
        known = bundle_of(recording)
        start = time.perf_counter()
        live = drain(measuring(first))
        between = time.perf_counter()
        whole = reconstruct(first).bundle
        end = time.perf_counter()
        assert whole is not None
        pictures = [shown(bundle, frames, recording) for bundle in (live, whole, known)]
        cells = (
            scene,
            f"{step:g} px",
            *(f"{100 * gain_error(bundle, known):.1f} %" for bundle in (live, whole)),
            f"{between - start:.1f}",
            f"{end - between:.1f}",
            *(f"{one:.1f} dB" for one in pictures),
        )
        print(f"| {' | '.join(cells)} |", flush=True)


def gain_error(found: Bundle, known: Bundle) -> float:
    """Return by how much gains differ from those known, beside those about them, 1 sigma."""
    distance, number = cKDTree(known.centres).query(found.centres)
    same = np.asarray(distance) < 0.2 * known.pitch
    ratio = found.brightness[same] / known.brightness[np.asarray(number)[same]]
    near = np.asarray(cKDTree(found.centres[same]).query(found.centres[same], k=NEIGHBOURS)[1])
    return float(1.48 * np.median(np.abs(ratio / np.median(ratio[near], axis=1) - 1)))


def shown(bundle: Bundle, frames: np.ndarray, recording: SimulatedRecording) -> float:
    """Return the PSNR of the last picture of a live engine with a bundle, dB."""
    engine = LiveEngine(bundle)
    for frame in frames:
        view = engine.push(frame)
    image = np.where(np.isfinite(view.image), view.image, np.nanmean(view.image))
    return quality(image, recording, len(frames) - 1)


if __name__ == "__main__":
    main()
