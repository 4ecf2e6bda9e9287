"""Small bursts that the tests share. Sides are odd and unequal, so that swapped axes show."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from napari_fiberburst import Burst, Reconstruction, reconstruct
from napari_fiberburst.simulation import SimulatedBurst, simulate

# Networks small enough that a step takes a millisecond.
SMALL = {
    "scene_width": 16,
    "scene_layers": 2,
    "motion_width": 16,
    "motion_layers": 1,
    "features": 16,
    "batch": 256,
    "device": "cpu",
}


@pytest.fixture(scope="session")
def tiny_simulation() -> SimulatedBurst:
    """Return 5 RGB frames of 31 x 37 pixels."""
    return simulate("histology", shape=(31, 37), frames=5, pitch=3.0, seed=2)


@pytest.fixture(scope="session")
def tiny_burst(tiny_simulation: SimulatedBurst) -> Burst:
    """Return the burst of the tiny simulation."""
    return tiny_simulation.burst


@pytest.fixture(scope="session")
def fit() -> Callable[..., Reconstruction]:
    """Return the published `reconstruct` with small networks on the CPU, ten steps where nothing else is said."""

    def small_fit(frames: Any, **choices: Any) -> Reconstruction:
        settings = {"preset": "paper", **SMALL, "iterations": 10, **choices}
        if settings.get("encoding", "fourier") != "fourier":
            del settings["features"]
        if settings.get("motion", "homography") == "none":
            del settings["motion_width"], settings["motion_layers"]
        return reconstruct(frames, **settings)

    return small_fit


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a seeded source of random numbers."""
    return np.random.default_rng(0)
