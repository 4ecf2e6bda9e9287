"""What goes wrong when a burst does not hold what the method needs, and what it says of that itself.

Five bursts of the same scene: a good one; one that does not move; two frames only; a frame that shows something else;
and cores so far apart that they miss the detail. Writes failures.png: above, a frame of each; below, the images.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.quality import match_levels, psnr
from napari_fiberburst.simulation import simulate

tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
side, frames = (81, 6) if tiny else (192, 12)
look: dict[str, Any] = {"shape": (side, side), "frames": frames, "channels": 1, "physics": "core", "seed": 5}

still = np.tile(np.eye(3), (frames, 1, 1))
good = simulate("cat", pitch=5.0, **look)
spoilt = good.arrays()["frames"].copy()
spoilt[3] = np.random.default_rng(0).permutation(spoilt[3].ravel()).reshape(spoilt[3].shape)

bursts = {
    "good": (good, good.burst),
    "no motion": ((frozen := simulate("cat", pitch=5.0, motion=still, **look)), frozen.burst),
    "two frames": (good, Burst(good.arrays()["frames"][:2, ..., 0])),
    "a spoilt frame": (good, Burst(spoilt[..., 0])),
    "coarse cores": ((coarse := simulate("cat", pitch=16.0, **look)), coarse.burst),
}
columns: list[NDArray[np.floating]] = []
for name, (simulated, burst) in bursts.items():
    result = reconstruct(burst, fill=True)
    truth = simulated.truth[0, ..., 0]
    print(f"{name}: {psnr(result.image, truth):.1f} dB, frames used: {result.frames_used}")
    for note in result.notes:
        print(f"   it says: {note}")
    drawn = np.concatenate([burst.frames[0, ..., 0], match_levels(result.image, truth)])
    columns.append(np.clip(drawn, 0, 1))
    columns.append(np.ones((2 * side, 6)))
Image.fromarray(np.rint(np.concatenate(columns[:-1], axis=1) * 255).astype(np.uint8)).save("failures.png")
