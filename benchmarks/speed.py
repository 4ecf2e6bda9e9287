"""How long the self-calibrating fit takes, with what memory, and how that grows.

Each burst is fitted in a process of its own, so that its peak memory can be read. Beside it, in the same run, some
steps of the published method are timed; it takes 3000.
"""

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path

from napari_fiberburst import Progress, Settings, iterate, read_burst, reconstruct
from napari_fiberburst.settings import choose
from napari_fiberburst.simulation import simulate

SIDES = (300, 424, 600)
PAPER_STEPS = 4


def fit(physics: str, side: int, path: str) -> None:
    """Fit one burst; print the seconds to the first preview and to the end, and this process's peak memory."""
    burst = read_burst(path) if path else simulate("histology", shape=(side, side), pitch=5.0, physics=physics).burst
    previews: list[float] = []

    def watch(report: Progress) -> None:
        if report.preview is not None:
            previews.append(time.perf_counter() - start)

    start = time.perf_counter()
    reconstruct(burst, device="cpu", preview_every=1e-9, on_progress=watch)
    total = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    print(f"{burst!s:45} {physics:5} first preview {previews[0]:5.1f} s, finished {total:5.1f} s, peak {peak:5.0f} MiB")


def published(side: int) -> None:
    """Time some steps of the published method."""
    settings: Settings = choose("paper", device="cpu", iterations=PAPER_STEPS + 1)
    run = iterate(simulate("histology", shape=(side, side), pitch=5.0).burst, settings)
    next(run)
    start = time.perf_counter()
    for _ in run:
        pass
    step = (time.perf_counter() - start) / PAPER_STEPS
    print(f"published method, 20 x {side} x {side}: {step:.2f} s a step, {3000 * step / 60:.0f} min for its 3000 steps")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--burst", default="", help="path of a burst to time as well")
    parser.add_argument("--fit", nargs=3, metavar=("PHYSICS", "SIDE", "PATH"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.fit:
        physics, side, path = options.fit
        fit(physics, int(side), path)
        return
    jobs = [(physics, side, "") for physics in ("mask", "core") for side in SIDES]
    if options.burst:
        jobs.append(("real", 0, str(Path(options.burst).resolve())))
    for physics, side, path in jobs:
        command = [sys.executable, __file__, "--fit", physics, str(side), path]
        print(subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip(), flush=True)
    published(SIDES[-1])


if __name__ == "__main__":
    main()
