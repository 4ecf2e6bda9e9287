"""Simulate a burst, fit it by the published method, and say how close it comes.

Takes about a minute on two cores.
"""

import os

from napari_fiberburst import reconstruct
from napari_fiberburst.quality import motion_error, psnr, ssim
from napari_fiberburst.simulation import simulate

# The tests run every example on a burst of a few pixels.
tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
shape, iterations = ((33, 41), 5) if tiny else ((256, 256), 1000)

simulated = simulate("cat", shape=shape, pitch=2.5)
rough = reconstruct(
    simulated.burst,
    preset="paper",
    sigma=2.0,  # as coarse as it takes not to follow the honeycomb
    iterations=iterations,
    learning_rate=1e-3,  # ten times the published steps, on smaller batches: a minute instead of an hour
    batch=2048,
    on_progress=lambda report: print(f"step {report.step}: loss {report.loss:.4f}", end="\r"),
)
# Steps of the published size let the image settle.
result = reconstruct(simulated.burst, initial=rough, iterations=iterations // 5, learning_rate=1e-4)

truth = simulated.truth[0]
print(f"\n{result.ending} after {len(result.losses)} steps in {result.seconds:.0f} s")
print(f"captured frame {psnr(simulated.burst.frames[0], truth):.1f} dB, {ssim(simulated.burst.frames[0], truth):.2f}")
print(f"reconstruction {psnr(result.image, truth):.1f} dB, {ssim(result.image, truth):.2f}")
print(f"motion off by {motion_error(result.homographies, simulated.homographies, shape):.2f} px")
result.save("cat.ome.tif")
