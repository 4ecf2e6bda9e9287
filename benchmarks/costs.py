"""Table 5: what the default costs in time and memory, how that grows, and where the time goes.

Each burst is fitted in a process of its own, so that its peak memory can be read.
"""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import psutil

from benchmarks import cases
from benchmarks.cases import Case
from benchmarks.results import COST, Recorder
from benchmarks.rows import Row
from napari_fiberburst import Burst, Progress, reconstruct
from napari_fiberburst.device import find_device
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.pipeline.diagnose import diagnose
from napari_fiberburst.pipeline.fitted import Fitted
from napari_fiberburst.pipeline.reconstruct import iterate
from napari_fiberburst.pipeline.stages import Stages
from napari_fiberburst.settings import SplineMethod, choose

Step = TypeVar("Step")
Value = TypeVar("Value")
# Steps of the published method that are timed, after a first one that loads much; and how many it takes in all.
PAPER_STEPS = 4
PUBLISHED_STEPS = 3000


def measure_costs(recorder: Recorder, *, device: str, is_quick: bool) -> None:
    """Fill the table."""
    recipe = {"device": device}
    for case in cases.costs(is_quick=is_quick):

        def compute(case: Case = case) -> Row:
            command = [sys.executable, "-m", "benchmarks.costs", json.dumps(asdict(case)), device]
            ended = subprocess.run(command, capture_output=True, text=True)
            if ended.returncode:
                raise FiberBurstError(f"the fit of {case.name} ended with {ended.returncode}: {ended.stderr}")
            found: Row = json.loads(ended.stdout)
            return found

        row = recorder.row(COST, case.name, "default", compute, recipe)
        times = f"first preview {row['first_preview']:5.1f} s, finished {row['seconds']:5.1f} s"
        print(f"  {case.name:30} {times}, peak {row['peak_mib']:5.0f} MiB", flush=True)
    case = cases.largest_cost(is_quick=is_quick)
    burst = case.make().burst
    row = recorder.row(COST, case.name, "paper", lambda: _published(burst, device), recipe)
    print(f"  published method: {row['seconds_a_step']:.2f} s a step, {row['seconds'] / 60:.0f} min for all its steps")
    row = recorder.row(COST, case.name, "stages", lambda: _stages(burst, device), recipe)
    print("  " + ", ".join(f"{name} {seconds:.1f} s" for name, seconds in row["stages"].items()))


def _fit(case: Case, device: str) -> Row:
    """Fit one burst in this process."""
    burst = case.make().burst
    previews: list[float] = []
    start = time.perf_counter()

    def watch(report: Progress) -> None:
        if report.preview is not None:
            previews.append(time.perf_counter() - start)

    reconstruct(burst, device=device, preview_every=1e-9, on_progress=watch)
    seconds = time.perf_counter() - start
    return {"first_preview": previews[0], "seconds": seconds, "peak_mib": _peak_memory()}


def _peak_memory() -> float:
    """Return the most memory that this process has had, MiB."""
    if sys.platform == "win32":
        peak: int = psutil.Process().memory_info().peak_wset
        return peak / 2**20
    status = Path("/proc/self/status")
    if status.exists():  # because on Linux the figure of `getrusage` includes the parent's
        return int(re.search(r"VmHWM:\s+(\d+) kB", status.read_text())[1]) / 2**10  # type: ignore[index]
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def _published(burst: Burst, device: str) -> Row:
    """Time some steps of the published method."""
    run = iterate(burst, choose("paper", device=device, iterations=PAPER_STEPS + 1))
    next(run)
    start = time.perf_counter()
    for _ in run:
        pass
    step = (time.perf_counter() - start) / PAPER_STEPS
    return {"seconds_a_step": step, "seconds": PUBLISHED_STEPS * step}


def _stages(burst: Burst, device: str) -> Row:
    """Time the default's stages."""
    spent: dict[str, float] = {}
    last = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal last
        now = time.perf_counter()
        spent[name] = spent.get(name, 0.0) + now - last
        last = now

    stages = Stages(burst, SplineMethod(), find_device(device))
    is_registered = False

    def lap_of_alignment(fitted: Fitted | None) -> None:
        nonlocal is_registered
        lap("calibrate" if fitted is None else "refine bundle and motion" if is_registered else "register")
        is_registered = is_registered or (fitted is not None and fitted.registration.stage == "complete")

    aligned = _followed(stages.align(), lap_of_alignment)
    lap("refine bundle and motion")
    solved = _followed(stages.solve(aligned), lambda _: lap("solve the scene, choose its smoothness"))
    lap("solve the scene, choose its smoothness")
    assert solved.scene is not None
    diagnose(burst, solved.bundle, solved.registration, solved.scene, solved.canvas)
    lap("coverage, uncertainty, residuals")
    return {"stages": spent}


def _followed(steps: Generator[Step, None, Value], follow: Callable[[Step], None]) -> Value:
    """Return what a generator returns, after a call for each value that it yields."""
    while True:
        try:
            step = next(steps)
        except StopIteration as end:
            value: Value = end.value
            return value
        follow(step)


if __name__ == "__main__":
    recipe, device = sys.argv[1:]
    print(json.dumps(_fit(Case(**json.loads(recipe)), device)))
