"""Long trials of what is promised, a line each; ends with status 1 where anything was lost.

python -m soak                 # all of them, under 15 minutes on two cores
python -m soak --part 0.1      # a tenth of each
python -m soak arrays killed   # some
"""

import argparse
import logging
import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import partial

from soak import faults, files, inputs, load
from soak.trials import Count, timed

# How often each trial is done; seconds of each reader for the fuzzed.
TRIALS: dict[str, tuple[Callable[[Count, int], None], int]] = {
    "bursts": (inputs.bursts, 3000),
    "arrays": (inputs.arrays, 250),
    "choices": (inputs.choices, 250),
    "damaged": (files.damaged, 120),
    "fuzzed": (files.fuzzed, 5),
    "many": (load.many, 1000),
    "at_once": (load.at_once, 1),
    "killed": (faults.killed, 20),
    "interrupted": (faults.interrupted, 16),
    "surroundings": (faults.surroundings, 1),
}
# It needs one core for as long as all others together, so it has a process of its own beside them.
BESIDE = "many"


def main() -> int:
    """Do the trials, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="TRIAL", help=f"of {', '.join(TRIALS)}; all by default")
    parser.add_argument("--part", type=float, default=1.0, help="of how often each is done")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    lost = 0
    names = options.names or list(TRIALS)
    beside = None
    if BESIDE in names and len(names) > 1:
        words = [sys.executable, "-m", "soak", BESIDE, "--part", str(options.part)]
        beside = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        names = [name for name in names if name != BESIDE]
    for name in names:
        trial, often = TRIALS[name]
        count = timed(name, partial(_do, trial, max(1, round(options.part * often))))
        lost += len(count.losses)
        print(count, flush=True)
    if beside is not None:
        print(beside.communicate()[0].rstrip(), flush=True)
        lost += beside.returncode
    return 1 if lost else 0


def _do(trial: Callable[[Count, int], None], often: int, count: Count) -> None:
    trial(count, often)


if __name__ == "__main__":
    sys.exit(main())
