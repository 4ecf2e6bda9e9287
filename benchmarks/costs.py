"""Table 5: what the default costs in time and memory, how that grows, and where the time goes.

Each burst is fitted in a process of its own, so that its peak memory can be read.
"""

import json
import re
import subprocess
import sys
import time
from itertools import product
from pathlib import Path

import psutil

from benchmarks.results import COST, Results, Row
from napari_fiberburst import Progress, reconstruct
from napari_fiberburst.device import find_device
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.pipeline.diagnose import diagnose
from napari_fiberburst.pipeline.reconstruct import iterate
from napari_fiberburst.pipeline.stages import Stages
from napari_fiberburst.settings import SplineMethod, choose
from napari_fiberburst.simulation import simulate

# Frames, side, channels: one of them grows while the others stay.
SIZES = (
    (5, 256, 3),
    (10, 256, 3),
    (20, 256, 3),
    (40, 256, 3),
    (20, 300, 3),
    (20, 424, 3),
    (20, 600, 3),
    (20, 256, 1),
    (20, 256, 8),
)
QUICK_SIZES = ((5, 96, 3), (10, 96, 3))
PITCH = 5.0
PAPER_STEPS = 4


def measure_costs(results: Results, *, device: str, is_quick: bool) -> None:
    """Fill the table."""
    sizes = QUICK_SIZES if is_quick else SIZES
    for physics, (frames, side, channels) in product(("core", "mask"), sizes):
        if physics == "mask" and side == 256 and (frames, channels) != (20, 3):
            continue  # how time grows is told by one physics
        size = f"{frames} x {side} x {side} x {channels}, {physics}"

        def compute(told: tuple[str, ...] = (str(frames), str(side), str(channels), physics, device)) -> Row:
            ended = subprocess.run([sys.executable, "-m", "benchmarks.costs", *told], capture_output=True, text=True)
            if ended.returncode:
                raise FiberBurstError(
                    f"the fit of {' x '.join(told[:3])} ended with {ended.returncode}: {ended.stderr}"
                )
            found: Row = json.loads(ended.stdout)
            return found

        row = results.row(COST, size, "default", compute, {"device": device})
        times = f"first preview {row['first_preview']:5.1f} s, finished {row['seconds']:5.1f} s"
        print(f"  {size:30} {times}, peak {row['peak_mib']:5.0f} MiB", flush=True)
    side = 96 if is_quick else 600
    row = results.row(
        COST, f"20 x {side} x {side} x 3, core", "paper", lambda: _published(side, device), {"device": device}
    )
    print(f"  published method: {row['seconds_a_step']:.2f} s a step, {row['seconds'] / 60:.0f} min for its 3000")
    row = results.row(
        COST, f"20 x {side} x {side} x 3, core", "stages", lambda: _stages(side, device), {"device": device}
    )
    print("  " + ", ".join(f"{name} {seconds:.1f} s" for name, seconds in row["stages"].items()))


def _fit(frames: int, side: int, channels: int, physics: str, device: str) -> Row:
    """Fit one burst in this process."""
    simulated = simulate(
        "histology", shape=(side, side), frames=frames, channels=channels, pitch=PITCH, physics=physics
    )
    previews: list[float] = []
    start = time.perf_counter()

    def watch(report: Progress) -> None:
        if report.preview is not None:
            previews.append(time.perf_counter() - start)

    reconstruct(simulated.burst, device=device, preview_every=1e-9, on_progress=watch)
    seconds = time.perf_counter() - start
    return {"first_preview": previews[0], "seconds": seconds, "peak_mib": _peak_memory()}


def _peak_memory() -> float:
    """Return the most memory that this process has had, MiB."""
    if sys.platform == "win32":
        peak: int = psutil.Process().memory_info().peak_wset
        return peak / 2**20
    status = Path("/proc/self/status")
    if status.exists():  # what `getrusage` tells on Linux begins with the parent's
        return int(re.search(r"VmHWM:\s+(\d+) kB", status.read_text())[1]) / 2**10  # type: ignore[index]
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def _published(side: int, device: str) -> Row:
    """Time some steps of the published method."""
    burst = simulate("histology", shape=(side, side), pitch=PITCH, physics="core").burst
    run = iterate(burst, choose("paper", device=device, iterations=PAPER_STEPS + 1))
    next(run)
    start = time.perf_counter()
    for _ in run:
        pass
    step = (time.perf_counter() - start) / PAPER_STEPS
    return {"seconds_a_step": step, "seconds": 3000 * step}


def _stages(side: int, device: str) -> Row:
    """Time the default's stages."""
    burst = simulate("histology", shape=(side, side), pitch=PITCH, physics="core").burst
    spent: dict[str, float] = {}
    last = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal last
        now = time.perf_counter()
        spent[name] = spent.get(name, 0.0) + now - last
        last = now

    stages = Stages(burst, SplineMethod(), find_device(device))
    fitted, is_registered = None, False
    steps = stages.align()
    while True:
        try:
            fitted = next(steps)
        except StopIteration as end:
            fitted = end.value
            break
        lap("calibrate" if fitted is None else "refine bundle and motion" if is_registered else "register")
        is_registered = is_registered or (fitted is not None and fitted.registration.stage == "complete")
    lap("refine bundle and motion")
    for _ in stages.solve(fitted):
        lap("solve the scene, choose its smoothness")
    scene = fitted.scene
    assert scene is not None
    diagnose(burst, fitted.bundle, fitted.registration, scene, fitted.canvas)
    lap("coverage, uncertainty, residuals")
    return {"stages": spent}


if __name__ == "__main__":
    frames, side, channels, physics, device = sys.argv[1:]
    print(json.dumps(_fit(int(frames), int(side), int(channels), physics, device)))
