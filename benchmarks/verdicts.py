"""Whether verdicts hold in both directions: no image that a fault has spoilt is called good, and no clean one doubtful.

    python -m benchmarks.verdicts
    python -m benchmarks.verdicts --scenes cat usaf

Bursts with the faults of Table 6 at its strengths and beyond them, each beside the same burst without the fault. Prints
what the fault costs, what the verdict is made of, and the verdict. The exit status is 1 where an image that has lost
more than 3 dB is good, or one of a burst without a fault is not.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.cases import Case
from benchmarks.compare import score
from benchmarks.methods import Outcome
from napari_fiberburst.pipeline import diagnose as judging
from napari_fiberburst.pipeline.reconstruct import reconstruct
from napari_fiberburst.pipeline.verdict import GoodnessOfFit, collect

MOST_LOSS = 3.0
FAULTS: Mapping[str, Mapping[str, Any]] = {
    "clean": {},
    "flicker 20 %": {"flicker": 0.2},
    "deformation 3 px": {"deformation": 3.0},
    "deformation 6 px": {"deformation": 6.0},
    "deformation 12 px": {"deformation": 12.0},
    "deformation 3 px over 25": {"deformation": 3.0, "deformation_length": 25.0},
    "smear 0.3": {"smear": 0.3},
    "smear 1": {"smear": 1.0},
    "background 20 %": {"background": 0.2},
    "background 100 %": {"background": 1.0},
    "vignette 4 x": {"vignette": 4.0},
    "round field": {"field": 0.7, "overlay": True},
    "intruder 5 %": {"intruder": 0.05},
    "intruder 20 %": {"intruder": 0.2},
    "1 black, 1 white": {"black_frames": 1, "white_frames": 1},
    "bundle shift 2 px": {"bundle_shift": 2.0},
    "contrast 6.6 %": {"contrast": 0.066},
    "all, mild": {"flicker": 0.03, "deformation": 1.0, "smear": 0.3, "background": 0.2},
}
# Bursts without a fault that are not easy.
HONEST: Mapping[str, Mapping[str, Any]] = {
    "6 frames": {"frames": 6},
    "300 electrons": {"photons": 300.0},
    "pitch 8": {"pitch": 8.0},
    "pitch 12": {"pitch": 12.0},
    "mask": {"physics": "mask"},
}


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        prog="verdicts", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=["histology", "tissue", "cat", "usaf"])
    parser.add_argument("--side", type=int, default=224)
    parser.add_argument("--only", nargs="+", help="names of faults; default all")
    options = parser.parse_args()
    wrong = 0
    for scene in options.scenes:
        base = Case(name="clean", scene=scene, side=options.side, pitch=4.7, channels=1, photons=8000.0)
        best = float("nan")
        for name, case, is_faulty in cases(base):
            if options.only and name not in options.only:
                continue
            quality, verdict, fit = judged(case)
            best = quality if name == "clean" else best
            loss = best - quality if is_faulty else 0.0
            is_wrong = (loss > MOST_LOSS and verdict == "good") or (not is_faulty and verdict != "good")
            wrong += is_wrong
            print(
                f"{scene:10}{name:26}{quality:6.2f} dB, loses {loss:6.2f}  error {fit.error:.3f}  misfit "
                f"{fit.misfit:6.2f}  uneven {fit.unevenness:5.2f}  structure {fit.structure:5.2f}  "
                f"{verdict}{'  WRONG' if is_wrong else ''}",
                flush=True,
            )
    print(f"{wrong} wrong")
    return 1 if wrong else 0


def cases(base: Case) -> Iterator[tuple[str, Case, bool]]:
    """Yield name, burst, and whether something is wrong with it."""
    for name, faults in FAULTS.items():
        yield name, replace(base, name=name, faults=faults), bool(faults)
    for name, change in HONEST.items():
        yield name, replace(base, name=name, **change), False


def judged(case: Case) -> tuple[float, str, GoodnessOfFit]:
    """Return PSNR, verdict and what it is made of."""
    simulated = case.make()
    kept: list[GoodnessOfFit] = []

    def keep(*arguments: Any) -> GoodnessOfFit:
        kept.append(collect(*arguments))
        return kept[-1]

    with patch.object(judging, "collect", keep):
        result = reconstruct(simulated.burst)
    image = np.nan_to_num(result.image if result.image.ndim == 3 else result.image[..., None])
    scale = simulated.burst.white_level - simulated.burst.black_level
    outcome = Outcome(image=image / scale, seconds=result.seconds, homographies=result.homographies)
    return float(score(outcome, simulated)["psnr"]), str(result.quality), kept[-1]


if __name__ == "__main__":
    sys.exit(main())
