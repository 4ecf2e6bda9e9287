"""Watch the published method while it fits, change its sigma on the way, stop it early, and continue it."""

import os

import numpy as np

from napari_fiberburst import Control, Progress, load, reconstruct
from napari_fiberburst.simulation import simulate

tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
shape, iterations = ((33, 41), 6) if tiny else ((128, 160), 200)

burst = simulate("tissue", shape=shape, frames=8, pitch=2.2).burst
control = Control()


def watch(report: Progress) -> None:
    """Take every report: here a finer sigma half way, and an end before the end."""
    if report.step >= iterations // 2:
        control.sigma = 2.0
    if report.step >= iterations - 2:
        control.stop()


first = reconstruct(
    burst,
    preset="paper",
    sigma=1.0,
    iterations=iterations,
    learning_rate=1e-3,
    on_progress=watch,
    control=control,
)
print(f"{first.ending} after {len(first.losses)} steps; sigma is {first.settings.value_of('sigma'):g}")

# The networks stand for the burst: saved, loaded, drawn at another size, continued.
first.save("tissue.npz")
again = load("tissue.npz")
print(
    f"drawn twice as large: {again.render(scale=2).shape}, or one corner: {again.render(bounds=(0, 0, 20, 10)).shape}"
)

longer = reconstruct(burst, initial=again, iterations=iterations)
print(f"loss {np.mean(first.losses[-5:]):.4f}, and {np.mean(longer.losses[-5:]):.4f} after {len(longer.losses)} steps")
