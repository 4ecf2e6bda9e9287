"""Fit one burst by whatever checkout PYTHONPATH names, for `benchmarks.side_by_side`, `benchmarks.speed` and others.

    python -P benchmarks/fit_once.py BURST.npz RESULT.npz

Of napari_fiberburst it imports what all versions have. In: `frames` (T, H, W, C) as recorded, `black_level` and
`white_level`, `scale`, image pixels to a frame pixel, and `device`; `task`, if it is not "fit": "kept", for a bundle
that is known from an earlier fit of the same burst, in versions that keep bundles, or "first picture", which ends with
the first preview. Out: `image`, frame 0's field, `seconds` of the processor without imports and reading, `peak`, by how
many bytes the fit has raised the most memory that the process has had, and `package`, the folder of the package that
made it. The processor's time, because on a shared machine a fit may wait for others as long as it computes; with one
thread it is what a user waits for on a quiet one.
"""

import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import napari_fiberburst
from napari_fiberburst import Burst, reconstruct


def main() -> None:
    """Read, reconstruct, write."""
    source, target = sys.argv[1:]
    with np.load(source) as file:
        inputs = {name: file[name] for name in file.files}
    task = str(inputs.get("task", "fit"))
    burst = Burst(
        inputs["frames"],
        axes="TYXC",
        black_level=float(inputs["black_level"]),
        white_level=float(inputs["white_level"]),
    )
    more: dict[str, Any] = {"device": str(inputs["device"]), "fill": True}
    previews: list[float] = []

    def note(report: Any) -> None:
        if report.preview is not None:
            previews.append(time.process_time())

    if task == "kept":
        known = getattr(reconstruct(burst, **more), "bundle", None)
        more |= {} if known is None else {"bundle": known}
    elif task == "first picture":
        more["preview_every"] = 1e-6
        more["on_progress"] = note
        more["should_stop"] = lambda: bool(previews)
    before = most_memory()
    start = time.process_time()
    result = reconstruct(burst, **more)
    image = result.image if inputs["scale"] == 1 else result.render(scale=float(inputs["scale"]))
    seconds = (previews[0] if previews else time.process_time()) - start
    peak = most_memory() - before
    package = str(Path(napari_fiberburst.__file__).parent)
    np.savez(target, image=image, seconds=seconds, peak=peak, package=package)


def most_memory() -> int:
    """Return the most memory that this process has had, bytes."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux's ru_maxrss begins with that of the process that has started this one
        return 1024 * int(status.read_text().split("VmHWM:")[1].split()[0])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    main()
