"""The status bar says what stands behind the pixel under the pointer, over a run's picture and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Image

from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.plugin.pointing import Pointing

HEIGHT, WIDTH = 31, 37
# Twice as fine as the frames, whose pixels are 0.5 by 0.25 long.
FINER = Canvas.over((-2, 0, WIDTH, HEIGHT + 3), scale=2)
SCALE = (1, 0.5, 0.25)


@pytest.fixture
def pointed(viewer, kept_run, tiny_simulation, grey_result):
    """Return a viewer and a run whose picture has known values, under a pointer that is followed."""
    rows, columns = FINER.shape
    row, column = np.mgrid[:rows, :columns].astype(np.float32)
    image = 100 + row + column / 100
    image[0, 0] = np.nan
    coverage = np.full(FINER.shape, 17.8, np.float32)
    coverage[5, 6], coverage[7, 8] = 0.0, 2.52
    known = {"coverage": coverage, "uncertainty": 0.02 + row}
    burst = viewer.add_layer(Image(tiny_simulation.arrays()["frames"][..., 1], name="burst", scale=SCALE))
    run = kept_run(viewer, [burst], "TYX", replace(grey_result, image=image, canvas=FINER, **known))
    runs = [run]
    pointing = Pointing(viewer, lambda: runs)
    yield viewer, run, pointing
    pointing.shut()


def point_at(viewer, row, column):
    """Move the pointer over a pixel of the image on `FINER`; return what the status bar says."""
    x, y = FINER.reference_from_image[:2] @ (column, row, 1)
    viewer.mouse_over_canvas = True
    viewer.cursor.position = (0.0, SCALE[1] * y, SCALE[2] * x)
    viewer.update_status_from_cursor()
    return viewer.status


@pytest.mark.parametrize(
    ("row", "column", "words"),
    [
        (0, 9, "run 1 [0 9]: 100.090 ± 0.020, from 18 samples"),
        (12, 40, "run 1 [12 40]: 112 ± 12, from 18 samples"),
        (7, 8, "run 1 [7 8]: 107.1 ± 7.0, from 2.5 samples"),
        (5, 6, "run 1 [5 6]: 105.1 ± 5.0, filled in from the surroundings: no sample has seen it"),
    ],
)
def test_value_uncertainty_and_samples_of_a_pixel_are_told(pointed, row, column, words):
    assert point_at(pointed[0], row, column) == words


def test_elsewhere_the_status_bar_is_naparis_own(pointed):
    viewer, run, pointing = pointed
    assert isinstance(point_at(viewer, 0, 0), dict), "the picture is see-through there"
    assert isinstance(point_at(viewer, -1, 5), dict)
    assert isinstance(point_at(viewer, 3, FINER.shape[1]), dict)
    assert isinstance(point_at(viewer, 3, 4), str)
    run.layers.switch("coverage", True)
    assert isinstance(point_at(viewer, 3, 4), dict), "another image lies on top"
    run.layers.set_visible("coverage", False)
    assert isinstance(point_at(viewer, 3, 5), str)
    run.layers.set_visible("image", False)
    assert isinstance(point_at(viewer, 3, 4), dict)
    run.layers.set_visible("image", True)
    pointing.shut()
    assert isinstance(point_at(viewer, 3, 5), dict)


def test_nothing_is_told_of_an_image_that_is_not_the_results(pointed):
    viewer, run, _ = pointed
    result = run.result
    run.layers.show_image(result.image + 1, result.acquisition, result.canvas)
    assert isinstance(point_at(viewer, 3, 4), dict), "its past is looked at"
    run.layers.show_image(result.image, result.acquisition, result.canvas)
    assert isinstance(point_at(viewer, 3, 5), str)
    run.result = None
    assert isinstance(point_at(viewer, 3, 4), dict), "it is being turned"


def test_colours_are_told_in_the_bursts_intensities(viewer, kept_run, burst_layer, colour_result):
    height, width = colour_result.canvas.shape
    image = np.broadcast_to(np.float32([200, 100, 50]), (height, width, 3))
    known = {"uncertainty": np.full((height, width), 1.5, np.float32), "coverage": None}
    viewer.add_layer(burst_layer)
    run = kept_run(viewer, [burst_layer], "TYXC", replace(colour_result, image=image, **known))
    pointing = Pointing(viewer, lambda: [run])
    viewer.mouse_over_canvas = True
    viewer.cursor.position = (0.0, 4.0, 5.0)
    viewer.update_status_from_cursor()
    pointing.shut()
    assert viewer.status == "run 1 [4 5]: 200.0, 100.0, 50.0 ± 1.5"


def test_a_closed_dock_leaves_the_status_bar_alone(open_dock, burst_layer):
    viewer, dock = open_dock(burst_layer)
    before = len(viewer.events.status.callbacks)
    dock.shut_down()
    assert len(viewer.events.status.callbacks) == before - 1
    dock.shut_down()
    dock.picture.open()
    assert len(viewer.events.status.callbacks) == before
