"""How long the import of the package and a simulated burst take, each in a fresh process on one core."""

import os
import statistics
import subprocess
import sys

RUNS = 5
IMPORT = "import time; start = time.perf_counter(); import napari_fiberburst; print(time.perf_counter() - start)"
SIMULATE = (
    "import time; from napari_fiberburst.simulation import simulate; simulate('cat', shape=(32, 32)); "
    "start = time.perf_counter(); simulate('histology', shape=(256, 256), physics={physics!r}); "
    "print(time.perf_counter() - start)"
)


def median_seconds(code: str) -> float:
    """Run code some times with one thread; return the median of the seconds it prints."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", code]
    printed = [subprocess.run(command, capture_output=True, check=True, env=environment).stdout for _ in range(RUNS)]
    return statistics.median(float(text) for text in printed)


def main() -> None:
    """Measure and print."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print(f"import napari_fiberburst: {median_seconds(IMPORT):.3f} s; limit 0.2 s")
    for physics in ("mask", "core"):
        took = median_seconds(SIMULATE.format(physics=physics))
        print(f"simulate 20 x 256 x 256 RGB, physics {physics}: {took:.2f} s; limit 1 s")


if __name__ == "__main__":
    main()
