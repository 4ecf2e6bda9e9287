"""Draw what each stage of the method comes to, for one burst: six pictures of one place.

Takes some ten seconds on two cores. Writes frame.png, bundle.png, samples.png, motion.png, coverage.png and image.png.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from napari_fiberburst import calibrate, diagnose, refine, register, remeasure, render, sample, solve
from napari_fiberburst.simulation import simulate

# The tests run every example on a burst of a few pixels.
tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
side, frames = (72, 6) if tiny else (192, 16)
middle = slice(side // 4, 3 * side // 4)  # what is shown
zoom = 3


def draw(name: str, image: NDArray[Any], high: float | None = None) -> None:
    """Write the middle of a grey or colour image, white at `high` or at its own brightest."""
    shown = np.nan_to_num(image[middle, middle].astype(np.float64))
    shown = shown / (np.percentile(shown, 99.8) if high is None else high)
    picture = Image.fromarray(np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8))
    picture.resize((zoom * picture.width, zoom * picture.height), Image.Resampling.NEAREST).save(f"{name}.png")


burst = simulate("cat", shape=(side, side), frames=frames, pitch=6.0, physics="core", channels=1, seed=1).burst
draw("frame", burst.frames[0, ..., 0])

# Step 1: the mean of the frames shows the bundle.
bundle = calibrate(burst)
draw("bundle", bundle.to_image(), high=255)

# Step 2: one value a core, painted over the pixels of the core.
samples = sample(burst, bundle)
values = np.append(samples.values[0, :, 0].cpu().numpy() * (samples.weights[0] > 0).cpu().numpy(), 0)
draw("samples", values[bundle.labels])

# Step 3: the way that the middle of the frames has gone, over the mean of the frames.
registration = register(samples)
bundle, registration = remeasure(burst, bundle, registration)
samples = sample(burst, bundle)
registration = refine(samples, registration)
draw("motion", burst.frames[..., 0].mean(axis=0))
path = Image.open("motion.png").convert("RGB")
places = registration.reference_from_frame @ np.array([side / 2, side / 2, 1])
points = [tuple(point) for point in zoom * (places[:, :2] / places[:, 2:] - middle.start)]
ImageDraw.Draw(path).line(points, fill=(255, 190, 60), width=2)
for x, y in points:
    ImageDraw.Draw(path).ellipse((x - 4, y - 4, x + 4, y + 4), fill=(255, 190, 60))
path.save("motion.png")

# Step 4: how often each place was seen, and the scene that explains all samples.
scene = solve(samples, registration)
found = diagnose(burst, bundle, registration, scene)
assert found.coverage is not None
draw("coverage", found.coverage)
draw("image", render(burst, bundle, registration, scene))
print(f"{len(bundle.centres)} cores, {frames} frames; {found.quality}")
