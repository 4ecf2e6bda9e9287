"""Simulate a burst, reconstruct it with nothing set, say how close it comes, and write an image of before and after.

Takes some ten seconds on two cores.
"""

import os

import numpy as np
from PIL import Image

from napari_fiberburst import reconstruct
from napari_fiberburst.quality import motion_error, psnr, ssim
from napari_fiberburst.simulation import simulate

# The tests run every example on a burst of a few pixels.
tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
shape = (61, 67) if tiny else (256, 256)

simulated = simulate("cat", shape=shape, frames=6 if tiny else 20, pitch=5.0, physics="core")
result = reconstruct(simulated.burst, fill=True)

captured, truth = simulated.burst.frames[0], simulated.truth[0]
print(f"{result.ending} in {result.seconds:.1f} s; notes: {result.notes}")
if result.bundle is not None and result.bundle.is_resolved:
    print(f"{len(result.bundle.centres)} cores, {result.bundle.pitch:.2f} px apart")
print(f"captured frame {psnr(captured, truth):.1f} dB, {ssim(captured, truth):.2f}")
print(f"reconstruction {psnr(result.image, truth):.1f} dB, {ssim(result.image, truth):.2f}")
print(f"motion off by {motion_error(result.homographies, simulated.homographies, shape):.3f} px")

result.save("cat.ome.tif")
brightest = np.percentile(result.image, 99.9)
parts = [captured, result.image / brightest, truth]
beside = np.concatenate([np.clip(part, 0, 1) for part in parts], axis=1)
Image.fromarray(np.rint(beside * 255).astype(np.uint8)).save("before_after_truth.png")
