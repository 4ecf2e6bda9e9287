"""What a rehearsal says of the error, against the error of a known scene that was never rehearsed."""

import numpy as np
import pytest

from napari_fiberburst import Bundle, Registration, sample
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.quality import match_levels
from napari_fiberburst.scene.rehearsal import Rehearsal
from napari_fiberburst.scene.spline import assemble
from napari_fiberburst.simulation import Camera, Scene, simulate

FREQUENCY = (np.arange(40) + 0.5) / 80


def power_law(shape, seed):
    """Return an image with the power 1e-6 f^-3, drawn by other means than the package's, and that power."""
    along_y, along_x = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None]
    distance = np.maximum(np.hypot(along_y, along_x), 0.5 / 80)
    white = np.fft.fft2(np.random.default_rng(seed).normal(size=shape))
    return np.fft.ifft2(white * np.sqrt(1e-6 * distance**-3)).real, 1e-6 * FREQUENCY**-3


@pytest.mark.parametrize("frames", [5, 20])
def test_the_error_that_is_rehearsed_is_the_error_there_is(frames):
    image, power = power_law((260, 280), seed=3)
    image = image + 0.5
    assert 0 < image.min() < image.max() < 1
    made = simulate(
        Scene(image.astype(np.float32)[..., None], (70, 60)),
        shape=(121, 134),
        frames=frames,
        channels=1,
        pitch=5.0,
        physics="core",
        camera=Camera(photons=1e6),
        seed=1,
    )
    samples = sample(made.burst, Bundle.from_image(np.round(made.flat * 255)))
    points = Registration.known(made.homographies, samples.shape, samples.cores).points(samples.positions)
    window = Grid(8.0, 8.0, 1.0, (104, 117))
    truth = made.truth[0, 8 : 8 + 104, 8 : 8 + 117, 0]

    equations = assemble(window, samples, points)
    rehearsal = Rehearsal.of(window, samples, points, FREQUENCY, power)
    rehearsed = assemble(window, rehearsal.samples, points)

    for smoothness in (0.03, 0.3):
        shown = equations.image(equations.solve(smoothness), smoothness)[0].numpy()
        inner = match_levels(shown[6:-6, 6:-6], truth[6:-6, 6:-6])
        told, _ = rehearsal.errors(rehearsed, rehearsed.solve(smoothness), smoothness)
        assert told == pytest.approx(np.square(inner - truth[6:-6, 6:-6]).mean(), rel=0.3)


def test_a_rehearsed_scene_has_the_power_that_was_asked_for():
    _, power = power_law((9, 9), seed=0)
    made = simulate("histology", shape=(91, 104), frames=3, channels=1, pitch=5.0, physics="core")
    samples = sample(made.burst, Bundle.from_image(np.round(made.flat * 255)))
    points = Registration.known(made.homographies, samples.shape, samples.cores).points(samples.positions)

    nodes = Rehearsal.of(Grid(0.0, 0.0, 1.0, (91, 104)), samples, points, FREQUENCY, power).nodes.numpy()

    spectrum = np.abs(np.fft.fft2(nodes)) ** 2 / nodes.size
    distance = np.hypot(np.fft.fftfreq(91)[:, None], np.fft.fftfreq(104)[None])
    for low, high in ((0.05, 0.1), (0.1, 0.2), (0.2, 0.4)):
        ring = (distance > low) & (distance < high)
        assert spectrum[ring].mean() == pytest.approx(np.interp(distance[ring], FREQUENCY, power).mean(), rel=0.2)
