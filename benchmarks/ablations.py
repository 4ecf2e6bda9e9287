"""Table 2: what each motion and each encoding is worth, with the self-calibrated bundle model and without it.

Without it a network is fitted to the frames as published; with it, the same network to the same burst's samples behind
the calibrated bundle, from the registration on. All learn for as many steps, at a step size that suits so few of them.
"""

from dataclasses import asdict
from typing import Any

from benchmarks.cases import Case
from benchmarks.compare import in_words, score
from benchmarks.methods import reconstructed
from benchmarks.results import ABLATION, Recorder
from benchmarks.rows import Row

MOTIONS = ("none", "flow", "flow_tv", "homography")
ENCODINGS = ("none", "nerf", "fourier", "hash", "siren")
# Adam's step size: five times the published 1e-4, because 1000 steps are a third of the published 3000.
LEARNING_RATE = 5e-4


def ablate(recorder: Recorder, case: Case, *, iterations: int, device: str, is_quick: bool) -> None:
    """Fill the table."""
    print(case, flush=True)
    pairs = [(motion, "fourier") for motion in MOTIONS] + [("homography", encoding) for encoding in ENCODINGS]
    pairs = [("none", "fourier"), ("homography", "fourier")] if is_quick else list(dict.fromkeys(pairs))
    for motion, encoding in pairs:
        for preset in ("paper", "auto"):
            _row(recorder, case, preset, motion, encoding, iterations=iterations, device=device)
    for motion in ("none", "homography"):
        _row(recorder, case, "auto", motion, "spline", iterations=None, device=device)


def _row(
    recorder: Recorder, case: Case, preset: str, motion: str, encoding: str, *, iterations: int | None, device: str
) -> None:
    choices: dict[str, Any] = {"preset": preset, "motion": motion, "encoding": encoding, "device": device}
    if iterations is not None:
        choices |= {"iterations": iterations, "learning_rate": LEARNING_RATE}
    if preset == "auto":
        choices |= {"fill": True}
    elif encoding == "fourier":
        choices |= {"sigma": case.sigma}

    def compute() -> Row:
        simulated = case.make()
        outcome = reconstructed(simulated, **choices)
        return {**score(outcome, simulated), "image": outcome.image}

    name = f"{motion} {encoding} {'with' if preset == 'auto' else 'without'} bundle model"
    recipe = {"burst": asdict(case), "bundle_model": preset == "auto", **choices}
    print(f"  {name:45} {in_words(recorder.row(ABLATION, case.name, name, compute, recipe))}", flush=True)
