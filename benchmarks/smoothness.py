"""What the smoothness that a burst chooses costs, beside the best one by the truth.

    python -m benchmarks.smoothness --bursts 25

Bursts are drawn at random, clean and with a fault, as `benchmarks/unseen.py` does. Each is reconstructed, and its scene
solved again at multiples of the smoothness that was chosen: the best of these stands beside it.
"""

import argparse
import statistics

import numpy as np

from benchmarks.side_by_side import as_channels
from benchmarks.unseen import unseen
from napari_fiberburst import reconstruct
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.quality import psnr
from napari_fiberburst.settings import SplineMethod
from napari_fiberburst.simulation import SimulatedBurst

_FACTORS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0)


def main() -> None:
    """Parse the arguments, reconstruct, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.smoothness", description=__doc__)
    parser.add_argument("--bursts", type=int, default=25, help="clean ones; each comes with a fault, too; default 25")
    parser.add_argument("--seed", type=int, default=500, help="of the first, default 500")
    options = parser.parse_args()
    losses = []
    print(f"{'burst':64}{'chosen':>9}{'best':>9}{'PSNR':>8}{'lost':>7}")
    for seed in range(options.seed, options.seed + options.bursts):
        drawn, faults = unseen(seed)
        fault, settings = next(faults)
        for name, made in ((f"{drawn}", drawn.make({})), (f"  {fault}", drawn.make(settings))):
            try:
                chosen, best, quality, lost = measure(made)
            except FiberBurstError as error:
                print(f"{name[:62]:64}{error}")
                continue
            losses.append(lost)
            print(f"{name[:62]:64}{chosen:9.4f}{best:9.4f}{quality:8.2f}{lost:7.2f}", flush=True)
    if losses:
        print(f"lost in the mean {statistics.mean(losses):.3f} dB, at worst {max(losses):.2f}, of {len(losses)} bursts")


def measure(made: SimulatedBurst) -> tuple[float, float, float, float]:
    """Return the smoothness that is chosen, the best one, the PSNR at the first, and what that loses to the best, dB.

    Raises
    ------
    FiberBurstError
        Nothing can be made of the burst, or it stands still, so that its scene cannot be solved again.
    """
    result = reconstruct(made.burst)
    method = result.settings.method
    if result.solver is None or not isinstance(method, SplineMethod) or method.smoothness is None:
        raise FiberBurstError("its scene cannot be solved again")
    chosen = method.smoothness
    look = result.solver.look()
    visible = np.ones(made.truth.shape[1:3], bool) if made.visible is None else made.visible
    quality = []
    for factor in _FACTORS:
        image = as_channels(look.image(smoothness=chosen * factor)[0])
        quality.append(psnr(image[visible][None], made.truth[0][visible][None]))
    best, own = int(np.argmax(quality)), _FACTORS.index(1.0)
    return chosen, chosen * _FACTORS[best], quality[own], quality[best] - quality[own]


if __name__ == "__main__":
    main()
