"""One frame through a bundle that is known: the real chart, beside what PyFibreBundle makes of the same frame.

    python -m benchmarks.single_frame FOLDER        # with burst.tif and background.tif; under a minute

The background image calibrates the bundle; frame 0 of the burst alone is reconstructed with it. Prints the scores of
Table 4 that one frame has, and draws the image of docs/bundle.md.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.chart import BLACK_LEVEL, Shown, finest
from benchmarks.real import CHART, FIELD, METHODS, SCALE, RealBurst
from napari_fiberburst import Bundle, Burst, reconstruct
from napari_fiberburst.data.canvas import Canvas

LABELS = {
    "captured": "raw frame",
    "gaussian-fixed": "Gaussian filter, 2 px",
    "pyfibrebundle": "PyFibreBundle, one frame",
    "bundle": "napari-fiberburst, one frame with its bundle",
}
# What the image shows, and how well it is kept.
DRAWN = ("captured", "pyfibrebundle", "bundle")
QUALITY = 80


def main() -> None:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--image", type=Path, help="a .webp file to draw")
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    real = RealBurst.read(options.folder, options.device)
    start = time.perf_counter()
    bundle = Bundle.from_image(options.folder / "background.tif", device=options.device)
    print(f"{bundle!r}, footprint {bundle.radius:.2f} px, in {time.perf_counter() - start:.1f} s\n")
    shown = {name: METHODS[name](real, real.frames[:1]) for name in LABELS if name in METHODS}
    shown["bundle"] = with_bundle(real, bundle)
    honeycomb = shown["captured"][0].ring()
    print("| | M, group 7 | finest element | ring | time |\n|---|---|---|---|---|")
    for name, (image, seconds) in shown.items():
        elements = list(image.elements())
        modulation = np.mean([row["modulation"] for row in elements if row["group"] == 7])
        ring = 20 * np.log10(image.ring() / honeycomb)
        print(f"| {LABELS[name]} | {modulation:.2f} | {finest(elements)} | {ring:.1f} dB | {seconds:.1f} s |")
    if options.image is not None:
        sheet = np.concatenate([part_of(shown[name][0]) for name in DRAWN], axis=1)
        Image.fromarray(sheet).save(options.image, quality=QUALITY)


def with_bundle(real: RealBurst, bundle: Bundle) -> tuple[Shown, float]:
    """Return what `reconstruct` makes of frame 0 with its bundle, and the seconds it took."""
    start = time.perf_counter()
    burst = Burst(real.frames[:1], black_level=BLACK_LEVEL, white_level=255)
    result = reconstruct(burst, bundle=bundle, device=real.device, fill=True)
    return Shown(result.render(scale=SCALE), Canvas.over(FIELD, SCALE)), time.perf_counter() - start


def part_of(shown: Shown) -> NDArray[np.uint8]:
    """Return the chart's groups 6 and 7, two pixels to one of the frame, dark bars at 5 % and light ones at 95 %."""
    x0, y0, _, _ = CHART
    middle = Canvas.over((x0 + 50, y0 + 150, x0 + 300, y0 + 400), SCALE).points()
    dark, light = shown.levels
    level = 0.9 * (shown.at(middle[..., 0], middle[..., 1]) - dark) / (light - dark) + 0.05
    drawn: NDArray[np.uint8] = np.rint(255 * np.clip(level, 0, 1)).astype(np.uint8)
    return np.pad(drawn, ((0, 0), (0, 6)), constant_values=255)


if __name__ == "__main__":
    main()
