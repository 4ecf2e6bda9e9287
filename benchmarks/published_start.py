"""How the start of the published method decides where it ends.

The published motion network starts some pixels away from the identity. Started at the identity itself, the frames lie
on one another at first, and a honeycomb that stands still explains them well. Both are fitted to the same bursts here,
with everything else as published, and their images are compared with the truth on the way.

    python -m benchmarks.published_start                  # some 20 minutes on two cores
    python -m benchmarks.published_start --steps 3000 --sigma 3
"""

import argparse
from itertools import product
from pathlib import Path

from benchmarks import report
from benchmarks.__main__ import RESULTS
from benchmarks.results import Curve, Results, write_start_curves
from napari_fiberburst import Burst, Reconstruction, reconstruct
from napari_fiberburst.networks.image import Representation
from napari_fiberburst.networks.layers import zero_output
from napari_fiberburst.networks.motion import HomographyField
from napari_fiberburst.quality import motion_error, psnr, ssim
from napari_fiberburst.simulation import SimulatedBurst, simulate

STEPS_BETWEEN_LOOKS = 40
PUBLISHED_SIGMA = 5.0  # cycles per half frame
LABELS = {"published": "start as published", "identity": "start at the identity"}


def main() -> None:
    """Fit from both starts, write the curves, draw them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--sigma", type=float, default=PUBLISHED_SIGMA, help="cycles per half frame, published 5")
    parser.add_argument("--side", type=int, default=384, help="of the frames, pixels")
    parser.add_argument("--bursts", type=int, nargs="+", default=[0, 2], help="seeds of the bursts, default 0 and 2")
    parser.add_argument("--starts", nargs="+", choices=LABELS, default=list(LABELS))
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder, default benchmarks/results")
    options = parser.parse_args()
    shape = (options.side, options.side)
    results = Results(options.results)
    for seed, start in product(options.bursts, options.starts):
        simulated = simulate("histology", shape=shape, frames=20, pitch=4.0, physics="mask", seed=seed)
        name = f"{LABELS[start]}, burst {seed}"
        if options.sigma != PUBLISHED_SIGMA:
            name += f", sigma {options.sigma:g}"
        print(name, flush=True)
        curve = fit(simulated, options.steps, options.sigma, is_identity=start == "identity")
        write_start_curves(options.results, {**results.start_curves, name: curve})
    report.write(results)


def fit(simulated: SimulatedBurst, steps: int, sigma: float, *, is_identity: bool) -> Curve:
    """Return (step, PSNR in dB, SSIM, motion error in pixels) along a fit."""
    curve: Curve = []
    truth = simulated.truth[0]
    result = unfitted(simulated.burst, sigma)
    if is_identity:
        start_at_identity(result)
    for end in range(STEPS_BETWEEN_LOOKS, steps + 1, STEPS_BETWEEN_LOOKS):
        result = reconstruct(simulated.burst, initial=result, iterations=STEPS_BETWEEN_LOOKS)
        moved = motion_error(result.homographies, simulated.homographies, truth.shape[:2])
        curve.append((end, psnr(result.image, truth), ssim(result.image, truth), float(moved)))
        print(f"{end:5d} {curve[-1][1]:6.2f} dB {curve[-1][2]:.3f} {curve[-1][3]:6.2f} px", flush=True)
    return curve


def unfitted(burst: Burst, sigma: float) -> Reconstruction:
    """Return the published method before its first step."""
    return reconstruct(burst, preset="paper", sigma=sigma, should_stop=lambda: True)


def start_at_identity(result: Reconstruction) -> None:
    """Make the motion network of a fit return the identity for every frame; the scene network stays as it is."""
    assert isinstance(result.renderer, Representation)
    motion = result.renderer.field.motion
    assert isinstance(motion, HomographyField)
    zero_output(motion.network)


if __name__ == "__main__":
    main()
