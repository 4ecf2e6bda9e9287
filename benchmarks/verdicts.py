"""Whether verdicts hold in both directions: no image that a fault has spoilt is called good, and no clean one doubtful.

    python -m benchmarks.verdicts
    python -m benchmarks.verdicts --scenes cat usaf
    python -m benchmarks.verdicts --unseen 200

Bursts with the faults of Table 6 at its strengths and beyond them, each beside the same burst without the fault; or so
many bursts drawn at random, a quarter of them without a fault. Prints what the fault costs, of that which both show,
what the verdict is made of, and the verdict; at the end, how often each verdict fell at each loss. The exit status is 1
where an image that has lost more than 3 dB is good, or one of a burst without a fault is not.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import peak_signal_noise_ratio

from benchmarks.cases import Case
from benchmarks.unseen import FAULTY_EACH, unseen
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.pipeline import diagnose as judging
from napari_fiberburst.pipeline.goodness import GoodnessOfFit, collect
from napari_fiberburst.pipeline.reconstruct import reconstruct
from napari_fiberburst.quality import match_levels
from napari_fiberburst.simulation import SimulatedBurst

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


# Losses, dB, that the last table tells apart.
LOSSES: Mapping[str, float] = {"less than 1 dB": 1.0, "1 to 3 dB": MOST_LOSS, "more than 3 dB": float("inf")}
VERDICTS = ("good", "doubtful", "bad")


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """An image and its verdict.

    Attributes
    ----------
    image : numpy.ndarray
        (H, W, C), 1 as full scale.
    reference : int
        The frame whose pixels it has.
    verdict : str
        "good", "doubtful" or "bad".
    fit : GoodnessOfFit
        What the verdict is made of.
    """

    image: NDArray[np.floating]
    reference: int
    verdict: str
    fit: GoodnessOfFit


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        prog="verdicts", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=["histology", "tissue", "cat", "usaf"])
    parser.add_argument("--side", type=int, default=224)
    parser.add_argument("--only", nargs="+", help="names of faults; default all")
    parser.add_argument("--unseen", type=int, metavar="N", help="instead, about N bursts drawn at random")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn")
    options = parser.parse_args()
    if options.unseen is not None:
        bursts = drawn_at_random(options.unseen, options.seed)
    else:
        bursts = (burst for scene in options.scenes for burst in of_table(scene, options.side, options.only))
    return report(bursts)


def report(bursts: Iterator[tuple[str, bool, SimulatedBurst, SimulatedBurst]]) -> int:
    """Print each burst of name, whether it has a fault, itself and the one to hold it to, and what they come to."""
    counts: Counter[tuple[str, str]] = Counter()
    wrong: list[str] = []
    twin: tuple[SimulatedBurst, Judged] | None = None
    for name, is_faulty, simulated, clean in bursts:
        try:
            if twin is None or twin[0] is not clean:
                twin = clean, judged(clean)
            found = judged(simulated) if simulated is not clean else twin[1]
        except FiberBurstError as error:
            print(f"{name:60}refused: {error}", flush=True)
            continue
        quality = fidelity(found, simulated, simulated.visible)
        loss = fidelity(twin[1], clean, simulated.visible) - quality if is_faulty else 0.0
        row = next(text for text, most in LOSSES.items() if loss <= most) if is_faulty else "no fault"
        counts[row, found.verdict] += 1
        fit = found.fit
        line = (
            f"{name:60}{quality:6.2f} dB, loses {loss:6.2f}  error {fit.error:.3f}  halves {fit.disagreement:.3f}  "
            f"misfit {fit.misfit:6.2f}  uneven {fit.unevenness:5.2f}  peak {fit.peak:5.2f}  "
            f"structure {fit.structure:5.2f}  still {fit.still:5.2f}  {found.verdict}"
        )
        is_wrong = (loss > MOST_LOSS and found.verdict == "good") or (not is_faulty and found.verdict != "good")
        if is_wrong:
            wrong.append(line)
        print(f"{line}{'  WRONG' if is_wrong else ''}", flush=True)
    print(f"\n{'loss':16}" + "".join(f"{verdict:>10}" for verdict in VERDICTS))
    for row in ("no fault", *LOSSES):
        print(f"{row:16}" + "".join(f"{counts[row, verdict]:10}" for verdict in VERDICTS))
    print("\n".join(["", f"{len(wrong)} wrong", *wrong]))
    return 1 if wrong else 0


def of_table(
    scene: str, side: int, only: list[str] | None
) -> Iterator[tuple[str, bool, SimulatedBurst, SimulatedBurst]]:
    """Yield the bursts of the table with one scene, as `report` takes them."""
    base = Case(name="clean", scene=scene, side=side, pitch=4.7, channels=1, photons=8000.0)
    clean = base.make()
    for name, faults in FAULTS.items():
        if not only or name in only:
            yield f"{scene}, {name}", bool(faults), replace(base, faults=faults).make() if faults else clean, clean
    for name, change in HONEST.items():
        if not only or name in only:
            hard = replace(base, **change).make()
            yield f"{scene}, {name}", False, hard, hard


def drawn_at_random(count: int, seed: int) -> Iterator[tuple[str, bool, SimulatedBurst, SimulatedBurst]]:
    """Yield bursts that no limit was tuned on, as `report` takes them."""
    for number in range(-(-count // (1 + FAULTY_EACH))):
        drawn, faulty = unseen(seed + number)
        clean = drawn.make({})
        print(drawn, flush=True)
        yield "  clean", False, clean, clean
        for name, faults in faulty:
            yield f"  {name}", True, drawn.make(faults), clean


def judged(simulated: SimulatedBurst) -> Judged:
    """Return image, verdict and what it is made of."""
    kept: list[GoodnessOfFit] = []

    def keep(*arguments: Any) -> GoodnessOfFit:
        kept.append(collect(*arguments))
        return kept[-1]

    with patch.object(judging, "collect", keep):
        result = reconstruct(simulated.burst)
    image = np.nan_to_num(result.image if result.image.ndim == 3 else result.image[..., None])
    scale = simulated.burst.white_level - simulated.burst.black_level
    return Judged(
        image=image / scale,
        reference=int(np.flatnonzero(np.isfinite(result.homographies).all(axis=(1, 2)))[0]),
        verdict=str(result.quality),
        fit=kept[-1],
    )


def fidelity(found: Judged, simulated: SimulatedBurst, visible: NDArray[np.bool_] | None) -> float:
    """Return PSNR of the pixels that are visible (H, W), all where None; in dB, after one gain and offset a channel."""
    truth = simulated.truth[found.reference].astype(np.float64)
    seen = np.ones(truth.shape[:2], dtype=bool) if visible is None else visible
    matched = match_levels(found.image[seen][None], truth[seen][None])
    return float(peak_signal_noise_ratio(truth[seen][None], matched, data_range=1))


if __name__ == "__main__":
    sys.exit(main())
