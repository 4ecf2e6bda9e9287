"""Your first burst: open it, reconstruct it with nothing set, look at it, and keep it.

The burst is simulated, so that its truth is known and the script needs no data. Takes some ten seconds on two cores.
Writes the burst, the image, before.png, after.png and truth.png, and report.html.
"""

import os

import numpy as np
import tifffile
from PIL import Image

from napari_fiberburst import read_burst, reconstruct, write_report
from napari_fiberburst.quality import motion_error, psnr, ssim
from napari_fiberburst.simulation import simulate

# The tests run every example on a burst of a few pixels.
tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
shape, frames = ((61, 67), 6) if tiny else ((256, 256), 20)

# --8<-- [start:record]
simulated = simulate("cat", shape=shape, frames=frames, pitch=5.0, physics="core")
recorded = np.rint(255 * simulated.burst.frames).astype(np.uint8)
known = {"axes": "TYXS", "PhysicalSizeX": 0.8, "PhysicalSizeY": 0.8}  # micrometres
tifffile.imwrite("burst.ome.tif", recorded, photometric="rgb", metadata=known)
# --8<-- [end:record]

# --8<-- [start:open]
burst = read_burst("burst.ome.tif")
print(burst)
print(f"a pixel is {burst.pixel_size} {burst.unit}")
# --8<-- [end:open]

# --8<-- [start:reconstruct]
result = reconstruct(burst)
print(f"{result.ending} in {result.seconds:.1f} s")
# --8<-- [end:reconstruct]

# --8<-- [start:trust]
print(f"the image is {result.quality}; to know before trusting it: {result.notes}")
print(f"frames used: {result.frames_used}")
print(f"detail is real down to periods of {result.resolution:.3} pixels")
print(result.bundle)
# --8<-- [end:trust]

# --8<-- [start:keep]
result.save("image.ome.tif")  # for measuring: image.json has its settings
result.save("after.png")  # for looking
write_report(result, burst, "report.html", name="burst.ome.tif")
# --8<-- [end:keep]

# --8<-- [start:truth]
captured, truth = simulated.burst.frames[0], simulated.truth[0]
image = np.where(np.isfinite(result.image), result.image, np.nanmean(result.image))
off = motion_error(result.homographies, simulated.homographies, shape)
print(f"captured frame {psnr(captured, truth):.1f} dB, {ssim(captured, truth):.2f}")
print(f"reconstruction {psnr(image, truth):.1f} dB, {ssim(image, truth):.2f}")
print(f"motion off by {off:.3f} px")
# --8<-- [end:truth]

for name, part in (("before", captured / captured.max()), ("truth", truth)):
    Image.fromarray(np.rint(255 * np.clip(part, 0, 1)).astype(np.uint8)).save(f"{name}.png")
