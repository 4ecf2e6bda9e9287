"""Where can the image be trusted? Coverage, uncertainty, and what was filled in.

The bundle is a circle and some of its cores are dead, so there are places that hardly any core has looked at.
Writes evidence.png: the image with its gaps, filled in, coverage, uncertainty, and how far it really is off.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from napari_fiberburst import reconstruct
from napari_fiberburst.quality import match_levels
from napari_fiberburst.simulation import simulate

tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
side, frames = (81, 4) if tiny else (256, 6)

bundle: dict[str, Any] = {"pitch": 6.0, "outline": "circle", "dead_cores": 0.1}
simulated = simulate("cat", shape=(side, side), frames=frames, channels=1, physics="core", seed=3, **bundle)
result = reconstruct(simulated.burst, canvas="frame")
filled = reconstruct(simulated.burst, fill=True)

assert result.coverage is not None  # as it is of the published method
assert result.uncertainty is not None
measured = result.coverage > 0
empty: NDArray[np.bool_] = np.isnan(result.image)
print(
    f"{measured.mean():.0%} of the pixels lie under a core's footprint in some frame, {empty.mean():.0%} are left empty"
)
print(
    f"typical uncertainty {np.nanmedian(result.uncertainty):.2g}, left-out samples: off by {result.held_out_rmse:.2g}"
)

truth = simulated.truth[0, ..., 0]
off = np.full(truth.shape, np.nan)
off[~empty] = np.abs(match_levels(result.image[~empty][None], truth[~empty][None]) - truth[~empty])[0]
uncertainty = np.where(empty, np.nan, result.uncertainty)
panels: list[NDArray[np.floating]] = []
for part in (result.image, filled.image, np.sqrt(result.coverage), uncertainty, off):
    low, high = np.nanpercentile(part, [0.5, 99.5])
    panels.append(np.clip(np.nan_to_num((part - low) / max(high - low, 1e-9)), 0, 1))
    panels.append(np.ones((side, 6)))
Image.fromarray(np.rint(np.concatenate(panels[:-1], axis=1) * 255).astype(np.uint8)).save("evidence.png")
