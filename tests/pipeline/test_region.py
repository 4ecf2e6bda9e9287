"""A region that is drawn while a network learns is learned first, and the rest as well as without."""

import numpy as np
import pytest
import torch

from napari_fiberburst import Control, reconstruct
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.networks.batches import PixelStream
from napari_fiberburst.simulation import simulate

REGION = (20.0, 15.0, 44.0, 36.0)
SMALL = {"scene_width": 64, "scene_layers": 2, "batch": 256, "device": "cpu"}
OF_METHOD = {
    "behind the bundle": {"encoding": "fourier", **SMALL},
    "as published": {"preset": "paper", "motion": "none", "learning_rate": 1e-3, **SMALL},
}


@pytest.fixture(scope="module")
def simulated():
    return simulate("cat", shape=(67, 81), frames=6, pitch=5.0, physics="core", seed=2)


def errors(simulated, method: str, steps: int, region: tuple[float, ...] | None) -> tuple[float, float]:
    """Return the root mean square error of a fit inside and outside the region, full scale 1."""
    control = Control()
    control.region = region
    image = reconstruct(simulated.burst, iterations=steps, control=control, **OF_METHOD[method]).image
    # As published, the honeycomb is learned too.
    goal, line = simulated.burst.frames[0], (1 / 255, 0.0)
    if method == "behind the bundle":
        goal, known = simulated.arrays()["truth"][0], np.isfinite(image)
        line = np.polyfit(image[known], goal[known], 1)  # the brightness of a bright core is not known
    off = (np.polyval(line, image) - goal) ** 2
    inside = np.zeros(image.shape[:2], dtype=bool)
    x0, y0, x1, y1 = map(int, REGION)
    inside[y0:y1, x0:x1] = True
    return float(np.nanmean(off[inside]) ** 0.5), float(np.nanmean(off[~inside]) ** 0.5)


@pytest.mark.parametrize(("method", "few", "many"), [("behind the bundle", 20, 100), ("as published", 40, 400)])
def test_its_error_falls_first_and_the_rest_is_not_harmed(simulated, method, few, many):
    early, early_favoured = (errors(simulated, method, few, region)[0] for region in (None, REGION))
    assert early_favoured < 0.97 * early
    late, late_favoured = (errors(simulated, method, many, region)[1] for region in (None, REGION))
    assert late_favoured < 1.02 * late


def test_a_region_that_nobody_sees_changes_nothing(fit, tiny_burst, same):
    control = Control()
    control.region = (1000.0, 1000.0, 1010.0, 1010.0)
    same(fit(tiny_burst, control=control), fit(tiny_burst))


def test_a_region_given_up_leaves_the_order_of_samples_as_it_was(tiny_burst):
    stream = PixelStream(tiny_burst, torch.device("cpu"), seed=0)
    other = PixelStream(tiny_burst, torch.device("cpu"), seed=0)
    stream.favour((5.0, 5.0, 20.0, 20.0), np.tile(np.eye(3), (5, 1, 1)))
    batch, plain = stream.draw(100), other.draw(100)
    assert len(batch.points) == 150
    torch.testing.assert_close(batch.points[:100], plain.points)
    x, y = ((batch.points[100:] + 1) / 2 * torch.tensor([37, 31]) - 0.5).T
    assert 4.99 < min(x.min(), y.min())
    assert max(x.max(), y.max()) < 20
    stream.favour(None, np.tile(np.eye(3), (5, 1, 1)))
    torch.testing.assert_close(stream.draw(100).points, other.draw(100).points)


@pytest.mark.parametrize("region", [(1, 2, 3), (5.0, 0.0, 5.0, 9.0), (0.0, 0.0, float("nan"), 9.0), "all"])
def test_what_is_no_region_is_refused(region):
    with pytest.raises(SettingsError, match="region must be x0, y0, x1, y1"):
        Control().region = region
