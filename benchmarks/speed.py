"""How long a reconstruction takes beside an earlier version of the package: what a user waits for, burst by burst.

    python -m benchmarks.speed
    python -m benchmarks.speed --burst FOLDER --long --traffic --publish docs

Both versions fit the same bursts in turn, each in a fresh process, because machines are shared and noisy; the time is
the least of the repeats, in seconds of the processor, imports left out. The earlier version is taken from the
repository's history into a folder of its own, which is deleted at the end. The exit status is 1 where a ratio of times
is 15 % above the one that was published: that is how a change that makes the package slower is seen.

--traffic adds how long the machine's memory takes to move what the tensor operations read and write: a fit that took no
longer would be bound by nothing else.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from benchmarks.real import RealBurst
from benchmarks.side_by_side import HERE, fitted, inputs_of, inputs_of_real
from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.errors import FiberBurstError, SettingsError
from napari_fiberburst.simulation import Camera, Faults, simulate

REFERENCE = "7aa3279"
PUBLISHED = HERE / "docs" / "speed.json"
TABLE = "speed_table.md"
MOST_SLOWER = 1.15
_COPIED = 25_000_000  # numbers, of the copy that measures the memory


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A burst and what is timed of it.

    Attributes
    ----------
    name : str
        As printed.
    recipe : dict
        Of `napari_fiberburst.simulation.simulate`; empty for the real burst.
    task : str
        As `benchmarks/fit_once.py` has it.
    goal : float
        That the ratio of times is to reach, where the issue of speed was opened.
    """

    name: str
    recipe: dict[str, Any]
    task: str = "fit"
    goal: float


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table; seconds, and bytes as a multiple of the frames as float32."""

    name: str
    before: float
    after: float
    goal: float
    memory: float
    traffic: float | None = None

    @property
    def ratio(self) -> float:
        """How many times as long it takes now."""
        return self.after / self.before


def _cores(side: int, frames: int = 20, channels: int = 1, **more: Any) -> dict[str, Any]:
    camera = Camera(photons=10_000.0)
    size = {"shape": (side, side), "frames": frames, "channels": channels}
    return {"scene": "histology", "physics": "core", "pitch": 5.0, "camera": camera, **size, **more}


ROWS: Sequence[Timed] = (
    Timed(name="20 x 448 x 448", recipe=_cores(448), goal=0.41),
    Timed(name="20 x 448 x 448, first picture", recipe=_cores(448), task="first picture", goal=0.42),
    Timed(name="20 x 448 x 448, kept bundle", recipe=_cores(448), task="kept", goal=0.21),
    Timed(name="20 x 448 x 448, bent by 3 px", recipe=_cores(448, faults=Faults(deformation=3.0)), goal=0.9),
    Timed(name="20 x 500 x 500 RGB", recipe=_cores(500, channels=3), goal=0.38),
    Timed(name="20 x 224 x 224 RGB, mask", recipe=_cores(224, channels=3, physics="mask", pitch=3.0), goal=0.35),
)
LONG = Timed(name="200 x 448 x 448", recipe=_cores(448, frames=200), goal=1.0)
REAL = Timed(name="real burst, 12 x 960 x 1280", recipe={}, goal=0.4)


def main() -> int:
    """Parse the arguments, fit, print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--reference", default=REFERENCE, help=f"the earlier version, a commit, default {REFERENCE}")
    parser.add_argument("--rows", nargs="+", metavar="TEXT", help="only rows whose names contain one of these")
    parser.add_argument("--long", action="store_true", help="add the row of 200 frames, which takes minutes")
    parser.add_argument("--burst", type=Path, help="folder with burst.tif and background.tif of the real chart")
    parser.add_argument("--traffic", action="store_true", help="add what the memory's bandwidth would allow")
    parser.add_argument("--repeats", type=int, default=2, help="fits by each version, default 2")
    parser.add_argument(
        "--publish", type=Path, help="folder for the table, and for its figures, which later runs are held to"
    )
    options = parser.parse_args()
    chosen = [*ROWS, *([LONG] if options.long else []), *([] if options.burst is None else [REAL])]
    if options.rows:
        chosen = [row for row in chosen if any(text in row.name for text in options.rows)]
    try:
        if options.repeats < 1:
            raise SettingsError(f"--repeats must be at least 1; got {options.repeats}")
        if not chosen:
            raise SettingsError(f"--rows must name parts of {', '.join(row.name for row in ROWS)}; got {options.rows}")
        published = read(PUBLISHED)
        bandwidth = memory_bandwidth() if options.traffic else None
        print(header("published x"), flush=True)
        rows = []
        with checked_out(options.reference) as other:
            for timed in chosen:
                rows.append(measure(timed, other, options.repeats, bandwidth, options.burst))
                print(line(rows[-1], _ratio_published(rows[-1], published)), flush=True)
    except FiberBurstError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if options.publish is not None:
        publish(rows, options.publish)
        return 0
    slower = [row.name for row in rows if is_slower(row, published)]
    if slower:
        print(f"slower than published by more than {100 * (MOST_SLOWER - 1):.0f} %: {', '.join(slower)}")
    return 1 if slower else 0


def publish(rows: Sequence[Row], folder: Path) -> None:
    """Write the table for the documentation and its figures; what was not measured anew stays."""
    path = folder / PUBLISHED.name
    known = read(path)
    for row in rows:
        measured = {key: value for key, value in asdict(row).items() if value is not None}
        known[row.name] = {**known.get(row.name, {}), **measured}
    path.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    lines = [header(), *(line(Row(**row)) for row in known.values())]
    (folder / TABLE).write_text("\n".join(lines) + "\n", encoding="utf-8")


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Check a commit of the repository out into a folder for as long as it is needed.

    Raises
    ------
    SettingsError
        The commit is not in this repository's history.
    """
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder, "earlier")
        git = ["git", "-C", str(HERE), "worktree"]
        added = subprocess.run([*git, "add", "--detach", str(target), commit], capture_output=True, text=True)
        if added.returncode:
            raise SettingsError(
                f"expected commit {commit} in the history of {HERE} ({added.stderr.strip().splitlines()[-1]}); "
                "a shallow clone gets it by: git fetch --unshallow"
            )
        try:
            yield target
        finally:
            subprocess.run([*git, "remove", "--force", str(target)], capture_output=True, check=True)


def measure(timed: Timed, other: Path, repeats: int, bandwidth: float | None, folder: Path | None) -> Row:
    """Time one row by both versions in turn."""
    inputs = _inputs(timed, folder)
    with tempfile.TemporaryDirectory() as scratch:
        source = Path(scratch, "burst.npz")
        np.savez(source, **inputs, task=timed.task)
        turns = [[fitted(checkout, source) for checkout in (other, HERE)] for _ in range(repeats)]
    before, after = zip(*turns, strict=True)
    return Row(
        name=timed.name,
        before=min(fit.seconds for fit in before),
        after=min(fit.seconds for fit in after),
        goal=timed.goal,
        memory=min(fit.peak for fit in after) / (4 * inputs["frames"].size),
        traffic=None if bandwidth is None or timed.task != "fit" else traffic(inputs) / bandwidth,
    )


def traffic(inputs: dict[str, Any]) -> int:
    """Return how many bytes the tensor operations of a fit read and write, as if nothing stayed in a cache."""
    burst = Burst(inputs["frames"], axes="TYXC", black_level=inputs["black_level"], white_level=inputs["white_level"])
    with _Counting() as counting:
        reconstruct(burst, device="cpu", fill=True)
    return counting.total


class _Counting(TorchDispatchMode):
    """Adds up the bytes of what every operation takes and returns; views move none."""

    def __init__(self) -> None:
        super().__init__()
        self.total = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call an operation and count."""
        result = function(*args, **(kwargs or {}))
        if not function.is_view:
            parts = tree_leaves((args, kwargs, result))
            self.total += sum(part.numel() * part.element_size() for part in parts if isinstance(part, torch.Tensor))
        return result


def memory_bandwidth() -> float:
    """Return how many bytes a second a copy between two large tensors reads and writes, the best of some."""
    source, target = torch.ones(_COPIED), torch.empty(_COPIED)
    times = []
    for _ in range(5):
        start = time.perf_counter()
        target.copy_(source)
        times.append(time.perf_counter() - start)
    return 2 * source.numel() * source.element_size() / min(times)


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Return published rows by name; none where nothing has been published."""
    known: dict[str, dict[str, Any]] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return known


def is_slower(row: Row, published: dict[str, dict[str, Any]]) -> bool:
    """Tell whether a row's ratio is well above the published one."""
    earlier = published.get(row.name)
    return earlier is not None and row.ratio > MOST_SLOWER * Row(**earlier).ratio


def header(*more: str) -> str:
    """Return the table's head, in Markdown, with more columns if any are named."""
    names = ["burst", "before", "now", "time x", "goal x", "memory x", "by memory alone", *more]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (names, ["---"] * len(names)))


def line(row: Row, *more: str) -> str:
    """Return a row of the table, in Markdown."""
    bound = "" if row.traffic is None else f"{row.traffic:.2f} s"
    times = [f"{row.before:.2f} s", f"{row.after:.2f} s", f"{row.ratio:.2f}", f"{row.goal:.2f}"]
    return "| " + " | ".join([row.name, *times, f"{row.memory:.1f}", bound, *more]) + " |"


def _ratio_published(row: Row, published: dict[str, dict[str, Any]]) -> str:
    earlier = published.get(row.name)
    return "-" if earlier is None else f"{Row(**earlier).ratio:.2f}"


def _inputs(timed: Timed, folder: Path | None) -> dict[str, Any]:
    if timed.recipe:
        return inputs_of(simulate(**timed.recipe), "cpu")
    assert folder is not None
    return inputs_of_real(RealBurst.read(folder, "cpu"), 1)


if __name__ == "__main__":
    sys.exit(main())
