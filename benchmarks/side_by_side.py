"""What a change costs in quality and time: the default of this checkout beside that of another one.

    git worktree add ../before COMMIT
    python -m benchmarks.side_by_side ../before --cases 1:cat "3:by hand" 5

Both fit the same bursts, in turn and each in a fresh process, because machines are shared and noisy; the time is the
least of the repeats, in seconds of the processor, imports left out. Where others compute on the same machine,
OMP_NUM_THREADS=1 makes it steadier. A burst has a PSNR against its truth, in dB. The real burst has no truth: its
quality is the modulation of the chart's finest bars (group 7), 20 log10 M, so that a difference is in dB too. The exit
status is 1 where a burst loses more than --most-loss, or the median ratio of times is above --most-time.
"""

import argparse
import math
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import cases
from benchmarks.cases import Case
from benchmarks.chart import Shown
from benchmarks.real import FIELD, SCALE, RealBurst
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.errors import FiberBurstError, SettingsError
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import SimulatedBurst

HERE = Path(__file__).parents[1]
FINEST_GROUP = 7
_WORKER = Path(__file__).with_name("fit_once.py")


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """A burst and how to judge an image of it.

    Attributes
    ----------
    name : str
        As printed.
    inputs : dict
        As `benchmarks/fit_once.py` reads them.
    quality : callable
        Image to quality, dB.
    """

    name: str
    inputs: dict[str, Any]
    quality: Callable[[NDArray[np.float32]], float]


@dataclass(frozen=True, kw_only=True)
class Pair:
    """One burst by both checkouts: quality in dB, least time in seconds, before and after."""

    name: str
    quality: tuple[float, float]
    seconds: tuple[float, float]

    @property
    def gain(self) -> float:
        """By how much the quality is better now, dB."""
        return self.quality[1] - self.quality[0]

    @property
    def ratio(self) -> float:
        """How many times as long it takes now."""
        return self.seconds[1] / self.seconds[0]

    def __str__(self) -> str:
        quality = f"{self.quality[0]:9.2f} {self.quality[1]:9.2f} {self.gain:+8.3f}"
        return f"{self.name:32}{quality} {self.seconds[0]:8.2f} {self.seconds[1]:8.2f} {self.ratio:7.2f}"


def main() -> int:
    """Parse the arguments, fit, print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.side_by_side",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("other", type=Path, help="the checkout from before the change")
    parser.add_argument(
        "--cases", nargs="+", metavar="CASE", help="a table, 1, 3, 5 or 6, or TABLE:NAME; default all but 6"
    )
    parser.add_argument("--quick", action="store_true", help="the small bursts of python -m benchmarks --quick")
    parser.add_argument("--burst", type=Path, help="folder with burst.tif and background.tif of the real chart")
    parser.add_argument("--repeats", type=int, default=3, help="fits by each checkout, default 3")
    parser.add_argument("--most-loss", type=float, default=0.1, help="that any burst may lose, dB, default 0.1")
    parser.add_argument("--most-time", type=float, default=1.1, help="for the median ratio of times, default 1.1")
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    try:
        if options.repeats < 1:
            raise SettingsError(f"--repeats must be at least 1; got {options.repeats}")
        for checkout in (options.other, HERE):
            check(checkout)
        chosen = find(options.cases, is_quick=options.quick)
        real = None if options.burst is None else RealBurst.read(options.burst, options.device)
        print(f"{'':32}{'before':>9} {'after':>9} {'dB':>8} {'before':>8} {'after':>8} {'time x':>7}", flush=True)
        pairs = []
        for trial in trials(chosen, real, options.device):
            pairs.append(compare(trial, options.other.resolve(), options.repeats))
            print(pairs[-1], flush=True)
    except FiberBurstError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    worst, slowest = min(pairs, key=lambda pair: pair.gain), max(pairs, key=lambda pair: pair.ratio)
    median = statistics.median(pair.ratio for pair in pairs)
    is_good = -worst.gain <= options.most_loss and median <= options.most_time
    print(
        f"worst difference {worst.gain:+.3f} dB ({worst.name}); time {slowest.ratio:.2f} x at worst ({slowest.name}), "
        f"{median:.2f} x in the median; {'within' if is_good else 'beyond'} the limits of {options.most_loss:g} dB and "
        f"{options.most_time:g} x"
    )
    return 0 if is_good else 1


def check(checkout: Path) -> None:
    """Refuse a folder without the package.

    Raises
    ------
    SettingsError
        There is no ``src/napari_fiberburst`` in it.
    """
    if not (checkout / "src" / "napari_fiberburst").is_dir():
        raise SettingsError(
            f"expected a checkout with src/napari_fiberburst in {checkout}; git worktree add FOLDER COMMIT makes one"
        )


def find(names: Sequence[str] | None, *, is_quick: bool) -> dict[str, Case]:
    """Return cases by TABLE:NAME; without names, all but those of recorded faults, which another may not bear.

    Raises
    ------
    SettingsError
        There is no such table or case.
    """
    tables = {1: cases.comparison, 3: cases.conditions, 5: cases.costs, 6: cases.recorded}
    known = {f"{number}:{case.name}": case for number, make in tables.items() for case in make(is_quick=is_quick)}
    chosen: dict[str, Case] = {}
    for name in names or ("1", "3", "5"):
        found = {full: case for full, case in known.items() if name in (full, full.partition(":")[0])}
        if not found:
            raise SettingsError(f"unknown case {name!r}; known: {', '.join(map(str, tables))}, {', '.join(known)}")
        chosen |= found
    return chosen


def trials(chosen: dict[str, Case], real: RealBurst | None, device: str) -> Iterator[Trial]:
    """Yield the bursts one by one, so that only one is in memory."""
    for name, case in chosen.items():
        yield simulated(name, case, device)
    if real is not None:
        yield recorded(real)


def simulated(name: str, case: Case, device: str) -> Trial:
    """Return a simulated burst, judged by its truth."""
    made = case.make()
    visible = np.ones(made.truth.shape[1:3], bool) if made.visible is None else made.visible

    def quality(image: NDArray[np.float32]) -> float:
        return psnr(as_channels(image)[visible][None], made.truth[0][visible][None])

    return Trial(name=name, inputs=inputs_of(made, device), quality=quality)


def inputs_of(made: SimulatedBurst, device: str) -> dict[str, Any]:
    """Return a simulated burst as `benchmarks/fit_once.py` reads it."""
    levels = {"black_level": made.burst.black_level, "white_level": made.burst.white_level}
    return {"frames": made.arrays()["frames"], **levels, "scale": 1, "device": device}


def recorded(real: RealBurst) -> Trial:
    """Return the real burst, judged by what it shows of the finest bars."""

    def quality(image: NDArray[np.float32]) -> float:
        elements = Shown(as_channels(image)[..., 0], Canvas.over(FIELD, SCALE)).elements()
        finest = [float(row["modulation"]) for row in elements if row["group"] == FINEST_GROUP]
        return 20 * math.log10(max(statistics.mean(finest), 1e-6))

    return Trial(name="real burst, modulation", inputs=inputs_of_real(real, SCALE), quality=quality)


def inputs_of_real(real: RealBurst, scale: int) -> dict[str, Any]:
    """Return the real burst as `benchmarks/fit_once.py` reads it."""
    levels = {"black_level": 0, "white_level": np.iinfo(real.frames.dtype).max}
    return {"frames": real.frames[..., None], **levels, "scale": scale, "device": real.device}


def as_channels(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an image as (H, W, C), black where nothing is known, as the tables judge it."""
    known: NDArray[np.float32] = np.nan_to_num(image)
    return known if known.ndim == 3 else known[..., None]


def compare(trial: Trial, other: Path, repeats: int) -> Pair:
    """Fit a burst by both checkouts in turn."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "burst.npz")
        np.savez(source, **trial.inputs)
        turns = [[fitted(checkout, source) for checkout in (other, HERE)] for _ in range(repeats)]
    before, after = zip(*turns, strict=True)
    return Pair(
        name=trial.name,
        quality=(trial.quality(before[-1].image), trial.quality(after[-1].image)),
        seconds=(min(fit.seconds for fit in before), min(fit.seconds for fit in after)),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """The image that a checkout makes of a burst, the seconds that it takes, and the bytes of memory at most."""

    image: NDArray[np.float32]
    seconds: float
    peak: float


def fitted(checkout: Path, source: Path) -> Fit:
    """Fit a burst by a checkout, in a process of its own.

    Raises
    ------
    FiberBurstError
        The fit has failed, or another package than the checkout's was imported.
    """
    target = source.with_name("result.npz")
    paths = os.pathsep.join([str(checkout / "src"), str(checkout)])
    command = [sys.executable, "-P", str(_WORKER), str(source), str(target)]
    environment = {**os.environ, "PYTHONPATH": paths}
    ended = subprocess.run(command, env=environment, cwd=checkout, capture_output=True, text=True)
    if ended.returncode:
        words = ended.stderr.strip().splitlines() or [f"exit status {ended.returncode}"]
        raise FiberBurstError(f"the fit by {checkout} failed: {words[-1]}")
    with np.load(target) as found:
        package = Path(str(found["package"]))
        if not package.resolve().is_relative_to(checkout.resolve()):
            raise FiberBurstError(f"expected the package of {checkout}; {package} was imported")
        return Fit(image=found["image"], seconds=float(found["seconds"]), peak=float(found["peak"]))


if __name__ == "__main__":
    sys.exit(main())
