"""Frames that are hundreds of cores wide, whose corners a turn moves by many pitches; and frames in uneven light."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.motion.approach import scales, smoothed, uneven_light
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


def missed_by(found, homographies):
    """Return by how much the corners of frames are misplaced at most, (T,), relative to the first frame."""
    true, ours = (
        transform_points(np.linalg.inv(matrices[0]) @ matrices, corners())
        for matrices in (homographies, found.scene_from_frame)
    )
    return np.abs(ours - true).max(axis=(1, 2))


def corners():
    height, width = SHAPE
    return np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], float)


def test_wide_frames_that_turn_are_registered(seen):
    homographies, samples = seen
    found = register(samples, bends=False)
    assert np.abs(transform_points(homographies, corners()) - corners()).max() > 8 * PITCH
    assert found.used.all()
    assert missed_by(found, homographies).max() < 0.3


def test_samples_are_smoothed_where_they_lie(seen):
    _, samples = seen
    spacing, _ = next(scales(SHAPE, PITCH))
    smooth = smoothed(samples, spacing)
    assert float(smooth.contrast) < 0.95 * float(samples.contrast)
    together = torch.corrcoef(torch.stack([smooth.grey.ravel(), samples.grey.ravel()]))[0, 1]
    assert float(together) > 0.7


def test_only_wide_frames_have_scales_of_their_own():
    assert not list(scales((448, 600), 5.0))
    spacings = [spacing for spacing, _ in scales((2048, 2048), 4.0)]
    assert spacings == [16.0, 8.0]


def vignetted(places):
    """Return light (N,) that falls to a sixth at the corners of the frame."""
    height, width = SHAPE
    away = (2 * places / torch.tensor([width - 1.0, height - 1.0]) - 1).square().sum(dim=1)
    return torch.exp(-0.9 * away)


def test_light_that_stands_still_does_not_hold_frames_back(seen):
    homographies, samples = seen
    some = torch.arange(0, len(samples.positions), 9)
    # Of a ninth of the cores, as of a bundle with cores three times as far apart, and an object of little contrast.
    faint = 1 + 0.3 * (samples.values[:, some] / samples.values.mean() - 1)
    light = vignetted(samples.positions[some])
    lit = replace(
        samples,
        positions=samples.positions[some],
        values=faint * light[:, None],
        weights=samples.weights[:, some],
        core_index=torch.arange(len(some)),
        cores=len(some),
        pitch=3 * PITCH,
    )
    ratio = uneven_light(lit) / light
    assert float(ratio.std() / ratio.mean()) < 0.05
    found = register(lit, bends=False)
    assert missed_by(found, homographies).max() < lit.pitch
