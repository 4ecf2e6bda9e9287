"""Bursts as they are recorded, with one fault each."""

from collections.abc import Callable

import numpy as np
import pytest

from napari_fiberburst import Reconstruction
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, Faults, SimulatedBurst, simulate

SHAPE = (137, 151)


@pytest.fixture(scope="session")
def recorded() -> Callable[..., SimulatedBurst]:
    """Return a function that simulates a burst of 137 x 151 pixels, by the faults' names."""

    def simulated(frames: int, seed: int, **faults: float) -> SimulatedBurst:
        return simulate(
            "histology",
            shape=SHAPE,
            frames=frames,
            channels=1,
            physics="core",
            pitch=4.7,
            seed=seed,
            camera=Camera(photons=8000, bits=10, exposure=0.8),
            faults=Faults(**faults),
        )

    return simulated


@pytest.fixture(scope="session")
def quality() -> Callable[[Reconstruction, SimulatedBurst], float]:
    """Return a function that gives the PSNR of an image, dB, where anything is known."""

    def of(result: Reconstruction, simulated: SimulatedBurst) -> float:
        seen = np.isfinite(result.image)
        return psnr(result.image[seen][None], simulated.truth[0, ..., 0][seen][None])

    return of
