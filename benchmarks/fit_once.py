"""Fit one burst by whatever checkout PYTHONPATH names, for `benchmarks.side_by_side`.

    python -P benchmarks/fit_once.py BURST.npz RESULT.npz

Of napari_fiberburst it imports what all versions have. In: `frames` (T, H, W, C) as recorded, `black_level` and
`white_level`, `scale`, image pixels to a frame pixel, and `device`. Out: `image`, frame 0's field, `seconds`
without imports and reading, and `package`, the folder of the package that made it.
"""

import sys
import time
from pathlib import Path

import numpy as np

import napari_fiberburst
from napari_fiberburst import Burst, reconstruct


def main() -> None:
    """Read, reconstruct, write."""
    source, target = sys.argv[1:]
    with np.load(source) as file:
        inputs = {name: file[name] for name in file.files}
    burst = Burst(
        inputs["frames"],
        axes="TYXC",
        black_level=float(inputs["black_level"]),
        white_level=float(inputs["white_level"]),
    )
    start = time.perf_counter()
    result = reconstruct(burst, device=str(inputs["device"]), fill=True)
    image = result.image if inputs["scale"] == 1 else result.render(scale=float(inputs["scale"]))
    seconds = time.perf_counter() - start
    np.savez(target, image=image, seconds=seconds, package=str(Path(napari_fiberburst.__file__).parent))


if __name__ == "__main__":
    main()
