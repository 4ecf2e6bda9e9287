"""How much memory runs take beside their bursts, and how much was estimated: a process each.

    python -m benchmarks.memory
    python -m benchmarks.memory --methods paper

Prints the peak beside the burst and what was there before, the estimate with the bundle known, as a run has it from its
first seconds on, and their ratio; then the largest that was off. The exit status is 1 where an estimate is off by more
than a quarter.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.fit_once import most_memory
from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.bundle.samples import lit_pixels
from napari_fiberburst.memory import estimate_memory
from napari_fiberburst.settings import choose
from napari_fiberburst.simulation import simulate

_MOST_OFF = 1.25
BURSTS: dict[str, dict[str, Any]] = {
    "20 x 256 x 256 RGB, mask": {"shape": (256, 256), "pitch": 6.0},
    "20 x 448 x 448 RGB": {"shape": (448, 448), "pitch": 4.7, "physics": "core"},
    "60 x 256 x 256 RGB": {"frames": 60, "shape": (256, 256), "pitch": 3.0, "physics": "core"},
    "80 x 300 x 300 RGB, mask": {"frames": 80, "shape": (300, 300), "pitch": 4.0},
    "6 x 700 x 600": {"frames": 6, "shape": (700, 600), "pitch": 4.0, "channels": 1, "physics": "core"},
    "100 x 448 x 448": {"frames": 100, "shape": (448, 448), "pitch": 4.7, "channels": 1, "physics": "core"},
    "20 x 1024 x 1024": {"shape": (1024, 1024), "pitch": 4.0, "channels": 1, "physics": "core"},
    "20 x 1024 x 1024, mask": {"shape": (1024, 1024), "pitch": 4.0, "channels": 1},
}
METHODS: dict[str, dict[str, Any]] = {
    "auto": {},
    "auto, upsample 2": {"upsample": 2.0},
    "auto, union": {"canvas": "union"},
    "fourier": {"encoding": "fourier", "iterations": 3},
    "siren": {"encoding": "siren", "iterations": 3},
    "hash": {"encoding": "hash", "iterations": 3},
    "paper": {"preset": "paper", "iterations": 3},
    "paper, 1 GB": {"preset": "paper", "iterations": 3, "memory": "1 GB"},
}
# The largest bursts take minutes by methods whose memory the others tell as well.
_SMALL = tuple(BURSTS)[:4]
_OF_ALL = ("auto", "paper", "paper, 1 GB")


def fit(path: Path, method: str) -> None:
    """Fit the burst in a file; print the peak beside it, and the estimate, bytes."""
    burst = Burst(np.load(path)["frames"])
    before = psutil.Process().memory_info().rss
    result = reconstruct(burst, **METHODS[method])
    peak = most_memory()
    settings = choose(**METHODS[method])
    known: dict[str, Any] = {}
    if result.bundle is not None:
        kind = result.settings.flat()["observation"]
        samples = len(result.bundle.centres) if kind == "cores" else int(lit_pixels(result.bundle).sum())
        known = {"kind": kind, "samples": samples}
    parts = 1
    if settings.memory is not None:
        from napari_fiberburst.memory import MemoryLimit

        parts = MemoryLimit(burst.shape, settings).parts(**known)
    print(json.dumps([peak - before, estimate_memory(burst.shape, settings, **known, parts=parts)]))


def main() -> int:
    """Measure, and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--bursts", nargs="+", choices=BURSTS, default=list(BURSTS))
    parser.add_argument("--fit", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.fit:
        fit(Path(options.fit[0]), options.fit[1])
        return 0
    worst = 1.0
    with tempfile.TemporaryDirectory() as folder:
        for name in options.bursts:
            path = Path(folder, "burst.npz")
            np.savez(path, frames=simulate("histology", **BURSTS[name], seed=0).burst.frames)
            for method in options.methods:
                if method not in _OF_ALL and name not in _SMALL:
                    continue
                command = [sys.executable, "-m", "benchmarks.memory", "--fit", str(path), method]
                printed = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
                taken, told = json.loads(printed.splitlines()[-1])
                worst = max(worst, told / taken, taken / told, key=abs)
                words = f"{taken / 2**20:6.0f} MiB, estimated {told / 2**20:6.0f}, {told / taken:.2f} x"
                print(f"{name:26} {method:18} {words}", flush=True)
    print(f"off by {worst:.2f} x at most; limit {_MOST_OFF} x")
    return int(worst > _MOST_OFF)


if __name__ == "__main__":
    sys.exit(main())
