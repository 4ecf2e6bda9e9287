"""How many frames are behind each pixel, against counting them one by one."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from napari_fiberburst import reconstruct
from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.pipeline.context import frames_behind
from napari_fiberburst.simulation import Camera, Faults, simulate

SHAPE = (157, 171)


@pytest.fixture(scope="module")
def burst():
    """Return frames of which one is black, with something that passes before the object in others."""
    return simulate(
        "histology",
        shape=SHAPE,
        frames=14,
        channels=1,
        physics="core",
        pitch=4.7,
        seed=1,
        camera=Camera(photons=8000, bits=10, exposure=0.8),
        faults=Faults(intruder=0.05, black_frames=1),
    ).burst


def counted(result, beyond):
    """Count the frames whose cores lie within the footprint's radius and `beyond` of each pixel."""
    places = result.canvas.points()
    count = np.zeros(places.shape[:2], int)
    for frame in result.frames_used:
        seen = result.bundle.centres[~result.outliers[frame]]
        moved = np.c_[seen, np.ones(len(seen))] @ result.homographies[frame].T
        count += cKDTree(moved[:, :2] / moved[:, 2:]).query(places)[0] <= result.bundle.radius + beyond
    return count


@pytest.mark.parametrize("how", [{}, {"upsample": 2}, {"canvas": "union"}])
def test_frames_behind_a_pixel_are_those_whose_cores_cover_it(burst, how):
    result = reconstruct(burst, observation="cores", smoothness=0.02, **how)
    assert result.outliers.any()
    assert len(result.frames_used) < 14
    assert result.context.shape == result.image.shape
    assert result.context.dtype == np.int32
    least, most = (counted(result, beyond) for beyond in (-1e-3, 1e-3))
    assert (least <= result.context).all()
    assert (result.context <= most).all()
    assert (least == most).mean() > 0.95
    assert result.context.max() <= len(result.frames_used)
    assert result.context[np.isnan(result.image)].max(initial=0) == 0


def test_pixels_count_as_far_as_their_corners():
    positions = torch.tensor([[2.0, 1.0], [6.0, 3.0]])
    weights = torch.tensor([[1.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    samples = Samples(
        kind="pixels",
        positions=positions,
        values=torch.ones(3, 2, 1),
        weights=weights,
        core_index=torch.tensor([0, 1]),
        cores=2,
        radius=None,
        shape=(5, 9),
        pitch=4.0,
        gain_variance=0.0,
    )
    points = positions.expand(3, 2, 2) + torch.tensor([[[0.0, 0.0]], [[0.2, -0.15]], [[40.0, 0.0]]])
    found = frames_behind(samples, points, np.array([True, True, True]), Canvas.over((0, 0, 9, 5)))
    expected = np.zeros((5, 9), int)
    expected[1, 2], expected[3, 6] = 2, 1
    np.testing.assert_array_equal(found, expected)
    alone = frames_behind(samples, points, np.array([True, False, False]), Canvas.over((0, 0, 9, 5)))
    np.testing.assert_array_equal(alone, np.minimum(expected, 1))
