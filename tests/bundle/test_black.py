"""The black level of frames that show no black is told from light that spreads between the cores."""

import numpy as np
import pytest
import torch

from napari_fiberburst import Bundle, calibrate
from napari_fiberburst.bundle.black import black_between_cores
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.simulation import Camera, Faults, simulate

LOOK = {"shape": (151, 173), "frames": 10, "channels": 1, "physics": "core", "pitch": 5.0, "seed": 3}


def recorded(scene, pedestal, contrast=None):
    camera = Camera(pedestal=pedestal, bits=12)
    faults = Faults() if contrast is None else Faults(contrast=contrast)
    return simulate(scene, camera=camera, faults=faults, **LOOK)


@pytest.mark.parametrize("scene", ["histology", "cat"])
@pytest.mark.parametrize("pedestal", [0.0, 0.1, 0.3])
def test_a_pedestal_is_found_between_black_cores(scene, pedestal):
    assert calibrate(recorded(scene, pedestal).burst, device="cpu").black / 4095 == pytest.approx(pedestal, abs=0.005)


@pytest.mark.parametrize(("scene", "above"), [("histology", 0.1), ("cat", 0.015)])
@pytest.mark.parametrize("pedestal", [0.0, 0.1, 0.3])
def test_light_between_the_cores_is_not_taken_for_black(scene, above, pedestal):
    """It is half of the object's light there, and the darkest place of the mean frame is far above the pedestal."""
    burst = recorded(scene, pedestal, contrast=0.2).burst
    assert calibrate(burst, device="cpu").black / 4095 == pytest.approx(pedestal, abs=0.04)
    assert np.quantile(burst.frames.mean(axis=0), 0.002) > pedestal + above


def test_where_all_light_goes_with_that_about_it_the_level_cannot_be_told():
    smooth = blur(torch.rand(6, 61, 67, generator=torch.Generator().manual_seed(0)), 9.0)
    assert black_between_cores(0.1 + smooth, 5.0) is None


def test_an_image_in_even_light_of_a_faint_bundle_is_not_black_between_the_cores():
    simulated = recorded("cat", 0.0, contrast=0.2)
    assert Bundle.from_image(simulated.transmission).black == 0
    assert Bundle.from_image(0.8 * recorded("cat", 0.0).transmission + 0.1).black == pytest.approx(0.1, abs=0.01)
