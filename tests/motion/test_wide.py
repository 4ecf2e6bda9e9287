"""Frames that are hundreds of cores wide: a turn moves their corners by many pitches."""

import numpy as np
import pytest
import torch

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.motion import wide
from napari_fiberburst.motion.register import register
from napari_fiberburst.simulation import Scene

SHAPE, PITCH = (1201, 1399), 5.0


def fine_detail(rng):
    """Return a scene with as much detail in each octave from a pitch to the size of a frame."""
    white = rng.standard_normal((512, 512))
    frequency = np.hypot(np.fft.fftfreq(512)[:, None], np.fft.rfftfreq(512))
    image = np.fft.irfft2(np.fft.rfft2(white) / np.maximum(frequency, 1 / 128), s=(512, 512))
    image = 0.5 + 0.15 * image / image.std()
    return Scene(np.kron(image, np.ones((3, 3)))[..., None].clip(0, 1).astype(np.float32))


def turned(angle, shift, tilt):
    """Return a frame that is turned about its middle, shifted and tilted."""
    height, width = SHAPE
    to_middle = np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1]])
    cosine, sine = np.cos(angle), np.sin(angle)
    matrix = np.array([[cosine, -sine, shift[0]], [sine, cosine, shift[1]], [tilt, 0, 1]])
    return np.linalg.inv(to_middle) @ matrix @ to_middle


@pytest.fixture(scope="module")
def seen():
    """Return samples of four frames, and where these lie."""
    rng = np.random.default_rng(3)
    height, width = SHAPE
    y, x = np.mgrid[0 : height : PITCH * 3**0.5 / 2, 0:width:PITCH]
    x = x + PITCH / 2 * (np.arange(len(x)) % 2)[:, None]
    places = np.stack([x.ravel(), y.ravel()], axis=1) + 0.1 * PITCH * rng.standard_normal((x.size, 2))
    places = places[(places >= 0).all(axis=1) & (places <= (width - 1, height - 1)).all(axis=1)]
    homographies = np.stack(
        [turned(*pose) for pose in ((0, (0, 0), 0), (0.03, (31, -20), 1e-5), (-0.02, (60, 9), 0), (0.05, (12, 44), 0))]
    )
    scene = fine_detail(rng)
    gains = rng.uniform(0.9, 1.1, len(places))
    light = np.stack([scene.sample(transform_points(matrix, places))[..., 0] for matrix in homographies])
    values = torch.from_numpy((light * gains).astype(np.float32))[..., None]
    return homographies, Samples(
        kind="cores",
        positions=torch.from_numpy(places.astype(np.float32)),
        values=values,
        weights=torch.ones(values.shape[:2]),
        core_index=torch.arange(len(places)),
        cores=len(places),
        radius=None,
        shape=SHAPE,
        pitch=PITCH,
        gain_variance=0.01,
    )


def test_wide_frames_that_turn_are_registered(seen):
    homographies, samples = seen
    found = register(samples, bends=False)
    height, width = SHAPE
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], float)
    true, ours = (
        transform_points(np.linalg.inv(matrices[0]) @ matrices, corners)
        for matrices in (homographies, found.scene_from_frame)
    )
    missed = np.abs(ours - true).max(axis=(1, 2))
    assert np.abs(transform_points(homographies, corners) - corners).max() > 8 * PITCH
    assert found.used.all()
    assert missed.max() < 0.3


def test_samples_are_smoothed_where_they_lie(seen):
    _, samples = seen
    spacing, _ = next(wide.scales(SHAPE, PITCH))
    smooth = wide.smoothed(samples, spacing)
    assert smooth.gain_variance == 0
    assert float(smooth.contrast) < 0.95 * float(samples.contrast)
    together = torch.corrcoef(torch.stack([smooth.grey.ravel(), samples.grey.ravel()]))[0, 1]
    assert float(together) > 0.7


def test_only_wide_frames_have_scales_of_their_own():
    assert not list(wide.scales((448, 600), 5.0))
    spacings = [spacing for spacing, _ in wide.scales((2048, 2048), 4.0)]
    assert spacings == [16.0, 8.0]
