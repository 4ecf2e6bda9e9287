"""Five faults of recorded bursts: tissue that bends, flicker, a faint bundle, a round field with marks, an intruder.

Nothing is set: each burst says by itself what is wrong with it. Writes recorded.png: above, a frame of each; below, the
images.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from napari_fiberburst import reconstruct
from napari_fiberburst.quality import match_levels, psnr
from napari_fiberburst.simulation import Faults, simulate

tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
side, frames = (81, 6) if tiny else (192, 14)
look: dict[str, Any] = {"shape": (side, side), "frames": frames, "channels": 1, "physics": "core", "seed": 1}
faults = {
    "tissue that bends": Faults(deformation=4),
    "flicker": Faults(flicker=0.2),
    "a faint bundle": Faults(contrast=0.066),
    "a round field with marks": Faults(field=0.8, overlay=True),
    "something passes before it": Faults(intruder=0.05),
}
columns: list[NDArray[np.floating]] = []
for name, fault in faults.items():
    simulated = simulate("histology", pitch=3.8 if fault.contrast else 4.7, faults=fault, **look)
    result = reconstruct(simulated.burst)
    truth = simulated.truth[0, ..., 0]
    known = np.isfinite(result.image)
    image = np.where(known, result.image, np.nanmean(result.image))
    print(f"{name}: {psnr(image[known], truth[known]):.1f} dB; motion {result.settings.method.motion.name}")
    print(f"   it says: {result.quality}; {'; '.join(result.notes) or 'nothing'}")
    shown = simulated.burst.frames[frames // 2, ..., 0]
    drawn = np.concatenate([shown / shown.max(), np.where(known, match_levels(image, truth), 0)])
    columns.append(np.clip(drawn, 0, 1))
    columns.append(np.ones((2 * side, 6)))
Image.fromarray(np.rint(np.concatenate(columns[:-1], axis=1) * 255).astype(np.uint8)).save("recorded.png")
