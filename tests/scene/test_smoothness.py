"""Smoothness that is chosen, against images of known scenes through known bundles at known motion."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from napari_fiberburst import Bundle, Registration, render, sample, solve
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, simulate


@pytest.mark.parametrize(
    ("scene", "photons", "frames", "channels"),
    [
        ("histology", 10_000.0, 20, 1),
        ("histology", 500.0, 20, 1),
        ("retina", 2000.0, 20, 1),
        ("histology", 10_000.0, 5, 1),  # gaps between samples
        ("histology", 300.0, 20, 3),  # channels are noisier than their mean
    ],
)
def test_the_smoothness_that_is_chosen_is_nearly_as_good_as_the_best(scene, photons, frames, channels):
    made = simulate(
        scene,
        shape=(121, 134),
        frames=frames,
        channels=channels,
        pitch=5.0,
        physics="core",
        camera=Camera(photons=photons),
    )
    bundle = Bundle.from_image(np.round(made.flat * 255))
    samples = sample(made.burst, bundle)
    motion = Registration.known(made.homographies, samples.shape, samples.cores)

    def quality(smoothness):
        scene = solve(samples, motion, smoothness=smoothness)
        image = render(made.burst, bundle, motion, scene, fill=True)
        return psnr(image.reshape(made.truth[0].shape), made.truth[0]), scene.smoothness

    chosen, smoothness = quality(None)
    best = max(quality(smoothness * factor)[0] for factor in (0.1, 0.3, 3.0))
    assert chosen > best - 0.6


@pytest.mark.parametrize("level", [0.0, 0.5])
def test_an_even_scene_without_noise_says_nothing_and_is_solved(level):
    made = simulate("histology", shape=(91, 104), frames=6, channels=1, pitch=5.0, physics="core", seed=2)
    samples = sample(made.burst, Bundle.from_image(np.round(made.flat * 255)))
    even = replace(samples, values=torch.full_like(samples.values, level))
    scene = solve(even, Registration.known(made.homographies, samples.shape, samples.cores))
    assert 0 < scene.smoothness < np.inf
    assert torch.isfinite(scene.coefficients).all()
