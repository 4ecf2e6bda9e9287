"""A burst of single cores and its reconstruction, which the tests of the self-calibrating fit share."""

from collections.abc import Callable

import numpy as np
import pytest

from napari_fiberburst import Reconstruction, reconstruct
from napari_fiberburst.simulation import SimulatedBurst, simulate


@pytest.fixture(scope="session")
def cores() -> SimulatedBurst:
    """Return 12 RGB frames of 127 x 141 pixels, seen through cores 6 pixels apart."""
    return simulate("histology", shape=(127, 141), frames=12, pitch=6.0, physics="core", seed=3)


@pytest.fixture(scope="session")
def fitted(cores: SimulatedBurst) -> Reconstruction:
    """Return what `reconstruct` makes of `cores`, gaps filled and every preview drawn."""
    return reconstruct(cores.burst, preview_every=1e-9, fill=True)


@pytest.fixture(scope="session")
def same() -> Callable[[Reconstruction, Reconstruction], None]:
    """Return a function that asserts that two runs came to the same bits."""

    def assert_same(first: Reconstruction, second: Reconstruction) -> None:
        np.testing.assert_array_equal(first.image, second.image)
        np.testing.assert_array_equal(first.homographies, second.homographies)
        np.testing.assert_array_equal(first.losses, second.losses)

    return assert_same
