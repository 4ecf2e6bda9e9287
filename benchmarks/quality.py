"""How close pictures come to the truth: captured frame, Gaussian filter, the published method, ours, and an oracle.

Every method sees the same simulated bursts. PSNR and SSIM are of frame 0, every pixel, after one gain and offset per
channel. The Gaussian filter has the width that is best by the truth; the published method sigma 2, which suits it here
better than its 5, and the steps that --paper-iterations gives it; the oracle is our solver, told the true motion and
transmission.
"""

import argparse

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from napari_fiberburst import Reconstruction, reconstruct
from napari_fiberburst.quality import motion_error, psnr, ssim
from napari_fiberburst.settings import choose
from napari_fiberburst.simulation import SimulatedBurst, simulate
from napari_fiberburst.solver.selfcalibrated import SelfCalibrated

# scene, physics, pitch, side, seed
BURSTS = (
    ("histology", "mask", 4.0, 384, 0),
    ("histology", "mask", 7.0, 256, 0),
    ("histology", "core", 4.0, 384, 0),
    ("histology", "core", 7.0, 256, 0),
    ("cat", "core", 5.0, 256, 1),
    ("tissue", "mask", 10.0, 256, 2),
    ("tissue", "core", 6.0, 256, 3),
    ("retina", "core", 7.0, 256, 4),
    ("usaf", "core", 7.0, 256, 5),
    ("histology", "core", 12.0, 320, 6),
)


def oracle(simulated: SimulatedBurst, physics: str) -> Reconstruction:
    """Return what our solver makes of a burst whose motion and transmission it is told."""
    image = torch.from_numpy(simulated.transmission).float()[..., None].repeat(1, 1, simulated.burst.shape[3])
    fit = SelfCalibrated(simulated.burst, choose(fill=True), image)
    fit.alignment.take(simulated.homographies, "pixels" if physics == "mask" else "cores")
    for _ in fit.solve():
        pass
    return fit.result()


def filtered(captured: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the captured frame filtered by the best of many widths."""
    tried = [gaussian_filter(captured, (sigma, sigma, 0)) for sigma in np.arange(0.5, 8.1, 0.25)]
    return max(tried, key=lambda picture: psnr(picture, truth))


def measure(scene: str, physics: str, pitch: float, side: int, seed: int, paper_iterations: int) -> None:
    """Print a row for every method on one burst."""
    simulated = simulate(scene, shape=(side, side), physics=physics, pitch=pitch, seed=seed)
    truth = simulated.truth[0]
    print(f"{scene}, {physics}, 20 x {side} x {side}, pitch {pitch:g}, seed {seed}")

    def row(name: str, picture: NDArray[np.float32], result: Reconstruction | None = None) -> None:
        line = f"  {name:16} {psnr(picture, truth):6.2f} dB  {ssim(picture, truth):.3f}"
        if result is not None:
            error = motion_error(result.homographies, simulated.homographies, truth.shape[:2])
            line += f"  motion off by {error:.3f} px  {result.seconds:6.1f} s"
        print(line, flush=True)

    captured = simulated.burst.frames[0]
    row("captured frame", captured)
    row("Gaussian filter", filtered(captured, truth))
    if paper_iterations:
        choices = {
            "preset": "paper",
            "sigma": 2.0,
            "iterations": paper_iterations,
            "learning_rate": 1e-3,
            "batch": 4096,
        }
        published = reconstruct(simulated.burst, **choices)  # type: ignore[arg-type]
        row("published", published.image, published)
    result = reconstruct(simulated.burst, fill=True)
    row("auto", result.image, result)
    best = oracle(simulated, physics)
    row("oracle", best.image, best)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--paper-iterations", type=int, default=200, help="steps of the published method; 0 skips it")
    parser.add_argument("--first", type=int, default=len(BURSTS), help="how many of the bursts")
    options = parser.parse_args()
    for burst in BURSTS[: options.first]:
        measure(*burst, options.paper_iterations)


if __name__ == "__main__":
    main()
