"""Can I trust it? Two bursts of one object, one that moves and one that hardly does: what each says of its own image.

Both are simulated, so that what they say can be held against the truth. Takes some ten seconds on two cores. Writes
good.png, poor.png, truth.png, uncertainty.png and error.png.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from napari_fiberburst import Reconstruction, reconstruct
from napari_fiberburst.quality import match_levels, psnr
from napari_fiberburst.simulation import Faults, SimulatedBurst, simulate

tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
side, frames = (81, 6) if tiny else (224, 14)


def picture(name: str, image: NDArray[Any], low: float, high: float) -> None:
    """Write an image, black at `low` and white at `high`."""
    scaled = np.clip((np.nan_to_num(image) - low) / (high - low), 0, 1)
    Image.fromarray(np.rint(255 * scaled).astype(np.uint8)).save(f"{name}.png")


def compare(name: str, simulated: SimulatedBurst, result: Reconstruction) -> NDArray[np.float64]:
    """Write the image at the levels of the truth, and return by how much it is off."""
    truth = simulated.truth[0, ..., 0]
    known = np.where(np.isfinite(result.image), result.image, np.nanmean(result.image))
    matched = match_levels(known, truth)
    print(f"{name}: {psnr(known, truth):.1f} dB against the truth")
    picture(name, matched, 0, 1)
    return np.where(np.isfinite(result.image), np.abs(matched - truth), np.nan)


look: dict[str, Any] = {"shape": (side, side), "frames": frames, "channels": 1, "pitch": 5.0, "physics": "core"}

# --8<-- [start:record]
# One frame is black, and something bright passes before the object.
good = simulate("histology", faults=Faults(black_frames=1, intruder=0.03), seed=4, **look)
# The same object through the same bundle, but it stands still.
still = np.tile(np.eye(3), (frames, 1, 1))
poor = simulate("histology", motion=still, seed=4, **look)
# --8<-- [end:record]

# --8<-- [start:ask]
results = {"good": reconstruct(good.burst), "poor": reconstruct(poor.burst)}
for name, result in results.items():
    print(f"{name}: {result.quality}")
    for note in result.notes:
        print(f"   {note}")
# --8<-- [end:ask]

# --8<-- [start:numbers]
for name, result in results.items():
    assert result.frames_used is not None  # as it is of the published method
    resolution = "unknown" if result.resolution is None else f"{result.resolution:.1f} px"
    outliers = 0 if result.outliers is None else result.outliers.sum()
    print(f"{name}: {len(result.frames_used)} of {frames} frames, resolution {resolution}, {outliers} outliers")
# --8<-- [end:numbers]

# --8<-- [start:uncertainty]
result = results["good"]
assert result.uncertainty is not None
off = compare("good", good, result)
compare("poor", poor, results["poor"])
# The image is in the burst's units, and the truth in its own.
gain = float(np.nanstd(result.image) / good.truth[0, ..., 0].std())
within = off * gain < 2 * result.uncertainty
part = within[np.isfinite(off)].mean()
print(f"{part:.0%} of the pixels are off by less than twice their uncertainty")
# --8<-- [end:uncertainty]

picture("truth", good.truth[0, ..., 0], 0, 1)
high = float(np.nanpercentile(off * gain, 99))
picture("uncertainty", result.uncertainty, 0, high)
picture("error", off * gain, 0, high)
