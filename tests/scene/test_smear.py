"""Frames that moved while they were exposed are seen to, and the scene is solved along the way that they went."""

from functools import cache

import numpy as np
import pytest
import skimage.data
import torch

from napari_fiberburst import reconstruct
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.pipeline.diagnose import diagnose
from napari_fiberburst.quality import motion_error
from napari_fiberburst.scene.smear import Smear
from napari_fiberburst.scene.solve import Scene
from napari_fiberburst.scene.spline import assemble
from napari_fiberburst.simulation import Camera, simulate
from napari_fiberburst.simulation import Scene as Object


def found(burst, monkeypatch):
    """Return the reconstruction of a burst, and what was found of its smear."""
    kept: list[Scene] = []

    def keep(*args, **kwargs):
        kept.append(args[3])
        return diagnose(*args, **kwargs)

    monkeypatch.setattr("napari_fiberburst.pipeline.outcome.diagnose", keep)
    return reconstruct(burst), kept[0].smear


@pytest.fixture(scope="module")
def smeared(recorded):
    """Return a function that gives a burst of 14 frames with so much smear, its reconstruction and what was found."""

    @cache
    def made(smear):
        simulated = recorded(frames=14, seed=4, smear=smear)
        with pytest.MonkeyPatch.context() as monkeypatch:
            return simulated, *found(simulated.burst, monkeypatch)

    return made


@pytest.mark.parametrize("smear", [0.7, 1.0])
def test_a_smear_is_found_and_its_blur_taken_out(smear, smeared, quality, monkeypatch):
    simulated, result, told = smeared(smear)
    # The simulated camera looks at moments up to both ends of the exposure, which spread as those of a longer one do.
    assert told.part == pytest.approx(1.18 * smear, abs=0.2)
    assert any("while they were exposed" in note for note in result.notes)
    monkeypatch.setattr("napari_fiberburst.scene.solve.find_smear", lambda *_: None)
    assert quality(result, simulated) > quality(reconstruct(simulated.burst), simulated) + 1.0


@pytest.mark.parametrize(("smear", "gain"), [(0.7, 0.1), (1.0, 0.4)])
def test_motion_and_gains_are_found_along_the_ways(smear, gain, smeared, quality, monkeypatch):
    simulated, result, _ = smeared(smear)
    monkeypatch.setattr("napari_fiberburst.pipeline.scenes.refine_along", lambda *given: given[1])
    before = reconstruct(simulated.burst)
    shape = simulated.truth.shape[1:3]
    error, error_before = (motion_error(one.homographies, simulated.homographies, shape) for one in (result, before))
    assert error < 0.85 * error_before
    assert quality(result, simulated) > quality(before, simulated) + gain
    np.testing.assert_allclose(result.homographies[result.reference], np.eye(3), atol=1e-9)


def test_smeared_frames_are_solved_again_to_the_same_bits(smeared):
    simulated, result, _ = smeared(0.7)
    again = result.solve_again(smoothness=0.02, leave_out=(4,))
    anew = reconstruct(simulated.burst, smoothness=0.02, leave_out=(4,))
    np.testing.assert_array_equal(again.image, anew.image)
    np.testing.assert_array_equal(result.solve_again().image, result.image)


def test_frames_that_rest_while_they_are_exposed_are_left_alone(recorded, monkeypatch):
    result, told = found(recorded(frames=14, seed=4).burst, monkeypatch)
    assert told is None
    assert not any("exposed" in note for note in result.notes)


def test_a_smooth_object_does_not_pass_for_a_smear(monkeypatch):
    retina = skimage.data.retina()[200:1200, 200:1200].astype(np.float32) / 255
    view = {"shape": (121, 147), "frames": 12, "pitch": 4.0, "channels": 1, "physics": "core", "seed": 4}
    simulated = simulate(Object(retina, (200, 700)), camera=Camera(photons=20_000.0), **view)
    result, told = found(simulated.burst, monkeypatch)
    assert told is None
    assert result.quality == "good"


def test_equations_along_paths_see_the_mean_of_the_way():
    """A scene is recovered from samples that are its means along straight ways of many lengths and directions."""
    generator = torch.Generator().manual_seed(0)
    grid = Grid(0.0, 0.0, 1.0, (41, 47))
    truth = torch.sin(grid.nodes()[..., 0] / 2.1) * torch.cos(grid.nodes()[..., 1] / 2.7)
    points = torch.rand(8, 1200, 2, generator=generator) * torch.tensor([38.0, 32.0]) + 4
    steps = torch.randn(8, 1, 2, generator=generator).expand(8, 1200, 2) * 3
    moments = torch.linspace(-0.5, 0.5, 41)
    ways = points[:, :, None] + moments[:, None] * steps[:, :, None]
    values = grid.at(ways)(truth).mean(dim=-1)
    samples = _Plain(values[..., None], torch.ones(8, 1200))
    errors = {}
    for name, looks in (("along", Smear(1.0, steps).paths(points)), ("at the middle", points)):
        scene = assemble(grid, samples, looks).solve(1e-4, iterations=300)[0]
        errors[name] = float((scene - truth)[8:-8, 8:-8].square().mean().sqrt())
    assert errors["along"] < 0.03
    assert errors["along"] < errors["at the middle"] / 3


class _Plain:
    """As much of samples as is assembled."""

    radius = None

    def __init__(self, values, weights):
        self.values, self.weights = values, weights


def test_frames_that_are_left_out_do_not_count_as_resting():
    steps = torch.zeros(4, 3, 2)
    steps[:2] = torch.tensor([3.0, 4.0])
    assert Smear(0.5, steps).length == pytest.approx(2.5)
