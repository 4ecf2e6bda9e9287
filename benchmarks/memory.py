"""How much memory a burst of 20 x 600 x 600 RGB takes at most: read from a file, fitted as published, drawn, saved."""

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from napari_fiberburst import reconstruct
from napari_fiberburst.simulation import simulate


def fit(path: Path) -> None:
    """Fit and save the burst in a file; print this process's peak memory in MiB."""
    result = reconstruct(path, preset="paper", iterations=4, device="cpu", preview_every=1e-6)
    result.save(path.with_name("image.ome.tif"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(peak / 2**20 if sys.platform == "darwin" else peak / 2**10)  # bytes there, KiB on Linux


def main() -> None:
    """Measure in a process of its own, and print."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "burst.npz")
        np.savez(path, frames=simulate("histology", shape=(600, 600), seed=0).arrays()["frames"])
        command = [sys.executable, __file__, str(path)]
        printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    print(f"20 x 600 x 600 RGB, uint8, published batch of 45000: peak memory {float(printed):.0f} MiB; limit 2048 MiB")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        fit(Path(sys.argv[1]))
    else:
        main()
