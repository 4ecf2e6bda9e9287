"""From a video to one wide picture: a hand-held probe wanders over tissue, and every frame finds its place.

Writes mosaic.png: one frame of the video beside the mosaic of all of them, at the same scale.
"""

import os
import tempfile
from pathlib import Path

import numpy as np
import zarr
from PIL import Image

from napari_fiberburst import mosaic, open_recording
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.simulation import simulate_recording

tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
side, frames = (81, 20) if tiny else (160, 240)

with tempfile.TemporaryDirectory() as folder:
    simulated = simulate_recording(path="handheld", shape=(side, side), frames=frames, turn=2.0, pitch=4.0, seed=4)
    video = write_video(simulated.source, Path(folder, "clip.avi"))

    source = open_recording(video)
    made = mosaic(source, Path(folder, "wide.ome.zarr"))
    picture = np.asarray(zarr.open_array(made.paths[0] / "0", mode="r")) / 255
    print(f"{frames} frames of {side} x {side} make {picture.shape[0]} x {picture.shape[1]} pixels; {made.quality}")
    for note in made.notes:
        print(note)
    frame = source.values([frames // 2])[0, ..., 0]

low, high = np.nanpercentile(picture, [0.5, 99.5])
wide = np.nan_to_num((picture - low) / (high - low), nan=1.0)
single = np.ones((len(wide), side))
top = max(0, (len(wide) - side) // 2)
single[top : top + side] = (frame / np.percentile(frame, 99.5))[: len(wide) - top]
both = np.clip(np.concatenate([single, np.ones((len(wide), 12)), wide], axis=1), 0, 1)
Image.fromarray(np.rint(both * 255).astype(np.uint8)).save("mosaic.png")
