"""What mosaics of long recordings reach, beside what is wanted of them.

    python -m benchmarks.recordings
    python -m benchmarks.recordings --quick --cases raster turning
    python -m benchmarks.recordings --publish docs

Every recording is simulated, so that its truth is exact, and written as FFV1, which loses nothing; each mosaic is made
of that file in a process of its own, so that neither the simulator's time nor its memory counts. Times are ratios to
`reconstruct` of a burst of 20 frames in a row out of the same file, in a process of its own right before, because
machines are shared and noisy. What a mosaic is worth is judged by its OME-Zarr and its table of poses alone,
a core distance inside its rim:

- places of frames after the one similarity that brings their middles closest to the true ones, because a mosaic has no
  frame of its own;
- PSNR beside the object itself, at the points where that similarity says that the pixels look, after one gain and
  offset;
- of tissue that bends there is no one truth: each pixel is held to the object at the point where the frames that have
  seen it look on average, at their places in the mosaic, bent as the track has them. So its geometry is free, and what
  is left is what frames that disagree have blurred.

Ends with status 1 where a goal is missed; --quick, smaller and shorter, shows that all of it runs and is held to none.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.mosaics import SIDE, STEP, Bench, Made, middles_of
from benchmarks.results import describe_machine, now
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.quality import ring_correlation
from napari_fiberburst.simulation import simulate_recording

TABLE, FIGURES = "recordings_table.md", "recordings.json"
_GIB = 2**30


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One figure.

    Attributes
    ----------
    case, what : str
        Of which recording, and what it is.
    found : float
        The figure.
    goal : float or None
        What it is wanted to be at most; None where it is only told.
    unit : str
        "px", "dB", "x", "GiB" or "".
    """

    case: str
    what: str
    found: float
    goal: float | None = None
    unit: str = ""

    @property
    def is_met(self) -> bool:
        """Whether it is as wanted."""
        return self.goal is None or self.found <= self.goal

    @property
    def cells(self) -> tuple[str, ...]:
        """As a line of a table."""
        goal = "" if self.goal is None else f"{self.goal:g} {self.unit}"
        met = "" if self.goal is None else ("yes" if self.is_met else "**no**")
        return self.case, self.what, f"{self.found:.3g} {self.unit}".strip(), goal.strip(), met


def places(name: str, made: Made, median: float | None, worst: float | None) -> list[Row]:
    """Return how well the frames of the largest piece are placed, and how many of all are."""
    missed = made.missed()
    return [
        Row(case=name, what="places of frames, median", found=float(np.median(missed)), goal=median, unit="px"),
        Row(case=name, what="places of frames, worst", found=float(missed.max()), goal=worst, unit="px"),
        Row(case=name, what="frames not in the largest piece", found=len(made.piece) - len(missed)),
    ]


def cost(name: str, made: Made, most: float | None, memory: float | None) -> list[Row]:
    """Return what a mosaic costs."""
    return [
        Row(case=name, what=f"{of} beside a burst's", found=made.cost[key] / made.burst[key], goal=goal, unit="x")
        for key, of, goal in (("cpu", "processor time", most), ("wall", "time", None))
    ] + [Row(case=name, what="peak memory", found=made.cost["peak"] / _GIB, goal=memory, unit="GiB")]


def raster(bench: Bench) -> list[Row]:
    """Measure 400 frames over a slide, row by row."""
    name, made = "raster, 400 frames", bench.raster
    lost = made.psnr_at_true_places() - made.psnr()
    return [
        *places(name, made, 0.15, 0.6),
        Row(case=name, what="PSNR", found=made.psnr(), unit="dB"),
        Row(case=name, what="PSNR lost to true places", found=lost, goal=0.8, unit="dB"),
        *cost(name, made, 8.0, 1.0),
    ]


def turning(bench: Bench) -> list[Row]:
    """Measure a probe that turns and whose magnification changes."""
    made = bench.made("turning", 400, turn=3.0, zoom=0.02)
    return places("turns by 3 degrees, zoom 2 %", made, 0.3, 1.0)


def longer(bench: Bench) -> list[Row]:
    """Measure how time grows with frames."""
    name, made = "raster, 1000 frames", bench.made("longer", 1000)
    grown = made.cost["cpu"] / bench.raster.cost["cpu"]
    row = Row(case=name, what="processor time beside that of 400", found=grown, goal=2.6, unit="x")
    return [*places(name, made, None, None), row, *cost(name, made, None, 1.0)]


def longest(bench: Bench) -> list[Row]:
    """Measure how memory grows with frames."""
    name, made = "raster, 4000 frames", bench.made("longest", 4000)
    return [*places(name, made, None, None), *cost(name, made, None, 1.0)]


def loop(bench: Bench) -> list[Row]:
    """Measure a circle that comes back to where it began."""
    count, side = bench.count(1000), bench.side
    angle = 2 * np.pi * np.arange(count) / (count - 1)
    radius = STEP * side / SIDE * count / (2 * np.pi)
    path = np.tile(np.eye(3), (count, 1, 1))
    path[:, 0, 2], path[:, 1, 2] = radius * np.sin(angle), radius * (1 - np.cos(angle))
    made = bench.made("loop", 1000, path=path)
    name, frames = "loop of 1000 frames", made.frames()
    found = middles_of((made.similarity() @ made.placed)[frames[[0, -1]]], made.truth)
    true = middles_of(made.truth.homographies[frames[[0, -1]]], made.truth)
    gap = float(abs((found[1] - found[0]) - (true[1] - true[0])))
    return [Row(case=name, what="does not close by", found=gap, goal=0.2, unit="px"), *places(name, made, None, None)]


def bending(bench: Bench) -> list[Row]:
    """Measure tissue that bends slowly."""
    name, made = "bends by 3 px", bench.made("bending", 400, bending=3.0)
    lost = bench.raster.psnr_with_free_geometry() - made.psnr_with_free_geometry()
    return [
        Row(case=name, what="PSNR lost, with the geometry free", found=lost, goal=1.5, unit="dB"),
        *places(name, made, None, None),
    ]


def laps(bench: Bench) -> list[Row]:
    """Measure what is gained where a path is gone ten times."""
    name, rows, periods = "40 frames, 10 times over", [], []
    for times in (1, 10):
        made = bench.made(f"laps-{times}", 40 * times, laps=times)
        resolution = _resolution(made)
        periods.append(resolution)
        rows += [
            Row(case=name, what=f"finest period shown after {times} laps", found=resolution, unit="px"),
            Row(case=name, what=f"PSNR after {times} laps", found=made.psnr(), unit="dB"),
        ]
    gained = Row(
        case=name, what="finest period beside that of 1 lap", found=periods[1] / periods[0], goal=1.0, unit="x"
    )
    return [gained, *rows]


def _resolution(made: Made) -> float:
    """Return the finest period at which picture and object agree, by Fourier ring correlation, pixels."""
    picture = made.picture()
    rows, columns = picture.shape
    height, width = (side // 2 for side in made.truth.source.shape[1:3])
    x, y = middles_of(made.placed[made.frames()], made.truth).mean().real, rows / 2
    top, left = max(0, round(y - height / 2)), max(0, round(float(x) - width / 2))
    part = (slice(top, min(rows, top + height)), slice(left, min(columns, left + width)))
    places_of = np.stack(np.meshgrid(np.arange(columns)[part[1]], np.arange(rows)[part[0]]), axis=-1)
    points = transform_points(made.similarity(), places_of.reshape(-1, 2).astype(np.float64))
    object_there = made.truth.world.sample(points)[:, 0].reshape(places_of.shape[:2])
    return ring_correlation(np.nan_to_num(picture[part]), object_there).resolution


def far(bench: Bench) -> list[Row]:
    """Measure long steps."""
    made = bench.made("far", 150, step=23.0 * (0.5 if bench.is_quick else 1.0))
    return places("steps of 23 px, 150 frames", made, None, None)


def resting(bench: Bench) -> list[Row]:
    """Measure a hand that rests at one place for half of the time."""
    frames, name = bench.count(200), "rests for 250 frames of 450"
    way = simulate_recording("slide", frames=frames, shape=(bench.side, bench.side), path="handheld", step=6.0, seed=1)
    rest = np.tile(way.homographies[frames // 2], (5 * frames // 4, 1, 1))
    rest[:, :2, 2] += np.random.default_rng(0).normal(0, 0.15, (len(rest), 2))
    path = np.concatenate([way.homographies[: frames // 2], rest, way.homographies[frames // 2 :]])
    made = bench.made("resting", 450, path=path, needs_true=True)
    lost = made.psnr_at_true_places() - made.psnr()
    return [*places(name, made, None, None), Row(case=name, what="PSNR lost to true places", found=lost, unit="dB")]


def slow(bench: Bench) -> list[Row]:
    """Measure a hand that moves by a quarter of a core distance from frame to frame."""
    made = bench.made("slow", 800, path="handheld", step=1.2)
    return places("steps of 1.2 px by hand, 800 frames", made, None, None)


def filtered(bench: Bench) -> list[Row]:
    """Measure what an endomicroscope's display shows, with lost contact and a cut."""
    made = bench.made(
        "filtered", 400, step=STEP, path="handheld", physics="filtered", field=0.95, overlay=True, gaps=1, jumps=1
    )
    name, unmet = "filtered, round field, a gap and a cut", made.unmet()
    count = int(made.piece.max()) + 1
    worst = max(float(made.missed(piece).max()) for piece in range(count))
    return [
        Row(case=name, what="pieces", found=count),
        Row(case=name, what="frame misplaced in its piece by, worst", found=worst, goal=1.0, unit="px"),
        Row(
            case=name,
            what="frame differs from the mosaic there, of its contrast, median",
            found=float(np.median(unmet)),
        ),
        Row(case=name, what="the same, worst", found=float(unmet.max())),
        *places(name, made, None, None),
        Row(case=name, what="frames that are out of contact", found=int((~made.truth.in_contact).sum())),
    ]


CASES: Mapping[str, Callable[[Bench], list[Row]]] = {
    "raster": raster,
    "turning": turning,
    "longer": longer,
    "loop": loop,
    "bending": bending,
    "laps": laps,
    "far": far,
    "resting": resting,
    "slow": slow,
    "filtered": filtered,
    "longest": longest,
}


def main() -> int:
    """Parse the arguments, measure, print, and publish."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.recordings",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="smaller and shorter, to see that all of it runs")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), help="default all")
    parser.add_argument("--publish", type=Path, help=f"folder for {TABLE} and {FIGURES}; cases not measured anew stay")
    options = parser.parse_args()
    measured: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), options.quick)
        for case in options.cases:
            before = os.getloadavg()[0]
            try:
                rows = CASES[case](bench)
            except FiberBurstError as error:
                print(f"error: {error}", file=sys.stderr)
                return 2
            measured[case] = {
                "rows": [asdict(row) for row in rows],
                "load": [before, os.getloadavg()[0]],
                "when": now(),
                "machine": describe_machine(),
            }
            print("\n".join(_line(row) for row in rows), flush=True)
            if options.publish is not None and not options.quick:
                publish(options.publish, measured)
    missed = [row for known in measured.values() for row in map(_row, known["rows"]) if not row.is_met]
    return 1 if missed and not options.quick else 0


def publish(folder: Path, measured: Mapping[str, Any]) -> None:
    """Write the figures, and their table for the documentation; what was not measured anew stays."""
    path = folder / FIGURES
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    known = {case: {**known, **measured}[case] for case in CASES if case in {**known, **measured}}
    path.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    lines = ["| recording | what | found | wanted, at most | met |", "| --- | --- | --- | --- | --- |"]
    lines += [_line(_row(row)) for one in known.values() for row in one["rows"]]
    (folder / TABLE).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _row(values: Mapping[str, Any]) -> Row:
    return Row(**values)


def _line(row: Row) -> str:
    return f"| {' | '.join(row.cells)} |"


if __name__ == "__main__":
    sys.exit(main())
