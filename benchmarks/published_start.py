"""How the start of the published method decides where it ends.

The published motion network starts some pixels away from the identity. Started at the identity itself, the frames lie
on one another at first, and a honeycomb that stands still explains them well. Both are fitted to the same burst here,
with everything else as published, and their pictures are held to the truth on the way.

    python -m benchmarks.published_start                  # some 15 minutes on two cores
    python -m benchmarks.published_start --steps 3000 --sigma 3
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import nn

from benchmarks.__main__ import RESULTS
from napari_fiberburst.networks import motion
from napari_fiberburst.networks.layers import output_of, zero_output
from napari_fiberburst.pipeline.reconstruct import reconstruct
from napari_fiberburst.quality import motion_error, psnr, ssim
from napari_fiberburst.simulation import SimulatedBurst, simulate

STEPS_BETWEEN_LOOKS = 40
LABELS = {"published": "start as published", "identity": "start at the identity"}

Curve = list[tuple[int, float, float, float]]


def main() -> None:
    """Fit from both starts, write the curves, draw them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--sigma", type=float, default=5.0, help="cycles per half frame, published 5")
    parser.add_argument("--side", type=int, default=384)
    parser.add_argument("--starts", nargs="+", choices=LABELS, default=list(LABELS))
    parser.add_argument("--output", type=Path, default=RESULTS / "published_start.json")
    options = parser.parse_args()
    shape = (options.side, options.side)
    simulated = simulate("histology", shape=shape, frames=20, pitch=4.0, physics="mask", seed=0)
    known = json.loads(options.output.read_text(encoding="utf-8")) if options.output.exists() else {}
    for start in options.starts:
        name = f"{LABELS[start]}, sigma {options.sigma:g}"
        known[name] = fit(simulated, options.steps, options.sigma, is_identity=start == "identity")
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(known), encoding="utf-8")
    draw(known, options.output.with_suffix(".png"))


def fit(simulated: SimulatedBurst, steps: int, sigma: float, *, is_identity: bool) -> Curve:
    """Return (step, PSNR in dB, SSIM, motion error in pixels) along a fit."""
    curve: Curve = []
    result = None
    original = motion.HomographyField.__init__
    if is_identity:
        motion.HomographyField.__init__ = from_identity(original)  # type: ignore[method-assign]
    try:
        for end in range(STEPS_BETWEEN_LOOKS, steps + 1, STEPS_BETWEEN_LOOKS):
            if result is None:
                result = reconstruct(simulated.burst, preset="paper", sigma=sigma, iterations=STEPS_BETWEEN_LOOKS)
            else:
                result = reconstruct(simulated.burst, initial=result, iterations=STEPS_BETWEEN_LOOKS)
            truth = simulated.truth[0]
            moved = motion_error(result.homographies, simulated.homographies, truth.shape[:2])
            curve.append((end, psnr(result.image, truth), ssim(result.image, truth), float(moved)))
            print(f"{end:5d} {curve[-1][1]:6.2f} dB {curve[-1][2]:.3f} {curve[-1][3]:6.2f} px", flush=True)
    finally:
        motion.HomographyField.__init__ = original  # type: ignore[method-assign]
    return curve


def from_identity(original: Callable[..., None]) -> Callable[..., None]:
    """Return a start of the motion network at which it returns the identity for every frame."""

    def start(self: Any, *given: Any) -> None:
        original(self, *given)
        network: nn.Sequential = self.network
        zero_output(network)
        assert not torch.any(output_of(network).weight)

    return start


def draw(curves: dict[str, Curve], path: Path) -> None:
    """Draw all curves there are."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for name, curve in sorted(curves.items()):
        steps, quality, alike, _ = np.array(curve).T
        axes[0].plot(steps, quality, label=name)
        axes[1].plot(steps, alike, label=name)
    for axis, label in zip(axes, ("PSNR, dB", "SSIM"), strict=True):
        axis.set_xlabel("steps")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[1].legend(frameon=False)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
