"""Draw a burst before and after: one frame, and what the default makes of all."""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from napari_fiberburst import read_burst, reconstruct


def main() -> None:
    """Reconstruct and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("burst", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("before_after.png"))
    parser.add_argument("--part", type=int, nargs=4, metavar=("X0", "Y0", "X1", "Y1"), help="of frame 0, pixels")
    options = parser.parse_args()
    burst = read_burst(options.burst)
    x0, y0, x1, y1 = options.part or (0, 0, burst.shape[2], burst.shape[1])
    result = reconstruct(burst)
    before = burst.acquisition.in_original_units(burst.frames[result.reference])[y0:y1, x0:x1]
    after = result.render(bounds=(x0, y0, x1, y1), scale=2)
    shown = []
    for image in (np.repeat(np.repeat(before, 2, axis=0), 2, axis=1), after):
        low, high = np.nanpercentile(image, [0.5, 99.5])
        level = np.nan_to_num((image - low) / (high - low))
        shown.append(np.rint(np.clip(level, 0, 1) * 255).astype(np.uint8))
    gap = np.full((shown[0].shape[0], 12, *shown[0].shape[2:]), 255, np.uint8)
    Image.fromarray(np.concatenate([shown[0], gap, shown[1]], axis=1)).save(options.output)
    print(f"{result.seconds:.1f} s, {result.settings.method}; wrote {options.output}")


if __name__ == "__main__":
    main()
