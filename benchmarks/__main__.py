"""Run the benchmark: every method on the same bursts, its tables and figures into a results folder.

`make bench` runs all of it, in some 90 minutes on two cores; `make bench-quick` a small part, in under 3 minutes.
A killed run goes on with --resume. Nothing is measured twice.
"""

import argparse
import logging
import sys
from pathlib import Path

from benchmarks import cases, methods, report
from benchmarks.ablations import ablate
from benchmarks.compare import SLOW, compare
from benchmarks.costs import measure_costs
from benchmarks.methods import Effort
from benchmarks.real import RealBurst, measure_real
from benchmarks.recorded import measure_recorded
from benchmarks.results import TABLES, Recorder
from napari_fiberburst.errors import FiberBurstError

NUMBERED = dict(enumerate(TABLES, start=1))
RESULTS = Path(__file__).with_name("results")


def main() -> int:
    """Parse the arguments, measure, write tables and figures."""
    options = parse()
    mode = "quick" if options.quick else "large" if options.large else "full"
    try:
        chosen = methods.find(options.methods)
        scenes = cases.find(options.scenes, cases.comparison(is_quick=options.quick, is_large=options.large))
        real = None if options.burst is None else RealBurst.read(options.burst, options.device)
        with Recorder(options.results, mode, resume=options.resume, overwrite=options.overwrite) as recorder:
            try:
                run(recorder, options, chosen, scenes, real)
            finally:  # the tables have all rows that there are, however the run ends
                report.write(recorder.results)
    except FiberBurstError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"wrote {options.results}: tables.md, figures, and rows, a file a table")
    return 0


def run(
    recorder: Recorder,
    options: argparse.Namespace,
    chosen: tuple[str, ...],
    scenes: tuple[cases.Case, ...],
    real: RealBurst | None,
) -> None:
    """Measure the rows of the chosen tables that are not there yet."""
    iterations = options.paper_iterations or (30 if options.quick else 3000)
    effort = Effort(paper_iterations=iterations, inpainting_steps=30 if options.quick else 600, device=options.device)
    for number in options.tables:
        print(f"Table {NUMBERED[number]}", flush=True)
        if number == 1:
            compare(recorder, NUMBERED[1], scenes, chosen, effort, images=True)
        elif number == 2:
            case = cases.ablation(is_quick=options.quick)
            steps = options.ablation_iterations or (20 if options.quick else 1000)
            ablate(recorder, case, iterations=steps, device=options.device, is_quick=options.quick)
        elif number == 3:
            fast = [name for name in chosen if name not in SLOW]
            bursts = cases.conditions(is_quick=options.quick)
            compare(recorder, NUMBERED[3], bursts, fast, effort, images=False)
        elif number == 4 and real is None:
            print("  skipped: --burst FOLDER names the real burst")
        elif number == 4:
            assert real is not None
            measure_real(recorder, real, chosen)
        elif number == 5:
            measure_costs(recorder, device=options.device, is_quick=options.quick)
        else:
            measure_recorded(recorder, cases.recorded(is_quick=options.quick), chosen, effort)


def parse() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="small bursts, few steps: shows that all of it runs")
    size.add_argument("--large", action="store_true", help="the first table at 1000 x 1000; for a GPU")
    parser.add_argument("--tables", type=int, nargs="+", choices=NUMBERED, default=list(NUMBERED), help="default all")
    parser.add_argument("--methods", nargs="+", metavar="NAME", help=f"default all: {', '.join(methods.METHODS)}")
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="of the first table; default all")
    parser.add_argument("--burst", type=Path, help="folder with burst.tif and background.tif of the real chart")
    parser.add_argument("--paper-iterations", type=int, help="steps of the published method, default its 3000")
    parser.add_argument("--ablation-iterations", type=int, help="steps of the second table's networks, default 1000")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder, default benchmarks/results")
    known = parser.add_mutually_exclusive_group()
    known.add_argument("--resume", action="store_true", help="keep the rows that are there, measure the others")
    known.add_argument("--overwrite", action="store_true", help="delete the rows that are there first")
    return parser.parse_args()


if __name__ == "__main__":
    logging.disable(logging.WARNING)  # the notes of a fit are in its row
    sys.exit(main())
