"""The published method, step by step: how its image comes, and what its one setting does.

Takes some minutes on two cores. Writes frame.png, the image after some of the steps, step_N.png, after.png once it has
settled, and sigma_N.png, what a coarser and a finer encoding make of the same burst.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from napari_fiberburst import Progress, Reconstruction, reconstruct
from napari_fiberburst.quality import match_levels, motion_error, psnr, ssim
from napari_fiberburst.simulation import simulate

# The tests run every example on a burst of a few pixels.
tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
shape, legs, more = ((33, 41), (2, 3), 5) if tiny else ((256, 256), (100, 200, 700), 200)


def picture(name: str, image: NDArray[Any]) -> None:
    """Write an image whose intensities are from 0 to 1."""
    Image.fromarray(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(f"{name}.png")


def tell(result: Reconstruction) -> None:
    """Say how close a result has come."""
    off = motion_error(result.homographies, simulated.homographies, shape)
    print(f"{len(result.losses):5} steps: loss {result.losses[-1]:.4f}, motion off by {off:.2f} px, ", end="")
    print(f"{psnr(result.image, truth):.1f} dB, {ssim(result.image, truth):.2f}")


def watch(report: Progress) -> None:
    """Show that something is going on."""
    print(f"step {report.step}: loss {report.loss:.4f}", end="\r")


# --8<-- [start:burst]
simulated = simulate("cat", shape=shape, pitch=2.5)
truth = simulated.truth[0]
picture("frame", simulated.burst.frames[0])
# --8<-- [end:burst]

# --8<-- [start:fit]
result = None
for steps in legs:
    result = reconstruct(
        simulated.burst,
        preset="paper",
        sigma=2.0,  # as coarse as it takes not to follow the honeycomb
        learning_rate=1e-3,  # ten times the published steps
        batch=2048,  # and smaller batches: minutes instead of an hour
        iterations=steps,
        initial=result,  # goes on exactly where the last leg has ended
        on_progress=watch,
    )
    tell(result)
    picture(f"step_{len(result.losses)}", match_levels(result.image, truth))
# --8<-- [end:fit]

# --8<-- [start:settle]
result = reconstruct(simulated.burst, initial=result, iterations=more, learning_rate=1e-4)
tell(result)
picture("after", match_levels(result.image, truth))
# --8<-- [end:settle]

# --8<-- [start:sigma]
others: dict[float, dict[str, Any]] = {
    0.5: {"learning_rate": 1e-3, "iterations": sum(legs[:2])},
    8.0: {"learning_rate": 1e-4, "iterations": 4 * legs[0]},
}
for sigma, choices in others.items():
    other = reconstruct(simulated.burst, preset="paper", sigma=sigma, batch=2048, **choices)
    print(f"sigma {sigma:g}:", end=" ")
    tell(other)
    other.save(f"sigma_{sigma:g}.png")
# --8<-- [end:sigma]
