"""From a video to a clean one: a hand trembles over tissue in light that flickers, and cells flash for three frames.

Writes video.gif: every frame as it was recorded beside the one that was made of it and those about it.
"""

import os
import tempfile
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray
from PIL import Image

from napari_fiberburst import open_recording, video
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.simulation import simulate_recording

tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
side, frames = (81, 20) if tiny else (128, 48)

with tempfile.TemporaryDirectory() as folder:
    simulated = simulate_recording(
        path="handheld",
        shape=(side, side),
        frames=frames,
        step=2.5,
        flicker=0.08,
        cells=40,
        flash=0.5,
        pitch=4.0,
        seed=4,
    )
    source = open_recording(write_video(simulated.source, Path(folder, "clip.avi")))
    made = video(source, Path(folder, "clean.ome.zarr"))
    clean = np.asarray(zarr.open_array(made.path / "0", mode="r"))
    recorded = source.recorded(range(frames))[..., 0].astype(np.float32)
    placed = int((made.track.piece >= 0).sum())
    print(f"{placed} of {frames} frames have a place; {made.window} stand behind each; {made.quality}")
    for note in made.notes:
        print(note)


def shown(light: NDArray[np.floating], levels: int) -> NDArray[np.floating]:
    """Return frames in so many grey levels, from the darkest to the brightest of all."""
    low, high = np.nanpercentile(light, [0.5, 99.8])
    steps: NDArray[np.floating] = np.rint(np.clip(np.nan_to_num((light - low) / (high - low)), 0, 1) * (levels - 1))
    return steps * (255 / (levels - 1))


between = np.full((frames, side, 6), 255.0)
# The honeycomb is noisy; fewer levels make a smaller file.
both = np.concatenate([shown(recorded, 24), between, shown(clean, 64)], axis=2).astype(np.uint8)
first, *others = [Image.fromarray(frame) for frame in both]
first.save("video.gif", save_all=True, append_images=others, duration=80, loop=0)
