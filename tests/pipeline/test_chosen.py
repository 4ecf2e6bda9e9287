"""What a result says of its making: all that was chosen, so that the same comes of it again."""

import json

import numpy as np
import pytest

from napari_fiberburst import Control, Settings, load, reconstruct
from napari_fiberburst.settings import choose
from napari_fiberburst.simulation import simulate

SHAPE = (67, 81)
NETWORK = {"scene_width": 16, "scene_layers": 1, "features": 16}
KINDS = {
    "spline": {},
    "network": {"encoding": "fourier", **NETWORK, "iterations": 45},
    "published": {"preset": "paper", "motion_width": 16, **NETWORK, "iterations": 45},
}


def burst_of(physics):
    return simulate("cat", shape=SHAPE, frames=6, pitch=5.0, physics=physics, seed=2).burst


@pytest.fixture(scope="module")
def burst():
    return burst_of("core")


def survives_json(settings):
    return Settings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_left_open_and_the_same_comes_of_it_again(burst, kind):
    reports = []
    result = reconstruct(burst, **KINDS[kind], on_progress=reports.append)
    assert result.requested == choose(**KINDS[kind])
    assert result.settings.left_open == ()
    assert survives_json(result.settings)
    assert reports[-1].settings == result.settings
    assert result.settings.device == result.device
    again = reconstruct(burst, preset=result.settings)
    assert again.requested == again.settings == result.settings
    if kind == "spline":
        # The gains come of a first image, which differs where its smoothness is known from the start.
        assert np.sqrt(np.nanmean((again.image - result.image) ** 2)) < 0.5  # of 255
        np.testing.assert_allclose(again.homographies, result.homographies, atol=1e-3)
    else:
        np.testing.assert_array_equal(again.image, result.image)
        np.testing.assert_array_equal(again.losses, result.losses)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("steps", [0, 4])
def test_nothing_is_left_open_where_a_run_is_stopped(burst, kind, steps):
    asked = iter(range(steps))
    result = reconstruct(burst, **KINDS[kind], should_stop=lambda: next(asked, None) is None)
    assert result.ending == "stopped"
    assert result.settings.left_open == ()
    assert survives_json(result.settings)
    if kind == "published" and steps:
        assert result.settings.method.iterations == len(result.losses) == steps
        np.testing.assert_array_equal(reconstruct(burst, preset=result.settings).image, result.image)


def test_a_network_that_is_stopped_while_it_learns_can_be_repeated(burst):
    control = Control()

    def stop(report):
        if report.settings.value_of("learning_rate") is not None and report.step > 1:
            control.stop()

    result = reconstruct(burst, encoding="fourier", **NETWORK, control=control, on_progress=stop)
    assert result.ending == "stopped"
    assert result.settings.method.iterations == len(result.losses) > 1
    np.testing.assert_array_equal(reconstruct(burst, preset=result.settings).image, result.image)


def test_an_end_that_was_left_open_is_told(burst, monkeypatch):
    monkeypatch.setattr("napari_fiberburst.pipeline.network._LEAST_PATIENCE", 20)
    small = {"scene_width": 8, "scene_layers": 1, "levels": 6, "batch": 96, "learning_rate": 0.1}
    result = reconstruct(burst, encoding="hash", **small)
    assert result.ending == "finished"
    assert result.settings.method.iterations == len(result.losses) < 2000
    np.testing.assert_array_equal(reconstruct(burst, preset=result.settings).image, result.image)


@pytest.mark.parametrize(("physics", "kind"), [("core", "cores"), ("mask", "pixels")])
def test_what_is_taken_as_a_sample_is_told(physics, kind):
    result = reconstruct(burst_of(physics))
    assert result.requested.value_of("observation") == "auto"
    assert result.settings.value_of("observation") == kind


def test_the_steps_of_a_continued_run_are_those_of_both_parts(fit, tiny_burst):
    half = fit(tiny_burst, iterations=12)
    whole = fit(tiny_burst, iterations=18, initial=half)
    assert whole.requested.method.iterations == 18
    assert whole.settings.method.iterations == 30
    np.testing.assert_array_equal(reconstruct(tiny_burst, preset=whole.settings).image, whole.image)
    # Without a number of its own, a run goes on for as many steps as the last one was asked for.
    assert len(reconstruct(tiny_burst, initial=whole).losses) == 48


@pytest.mark.parametrize("kind", KINDS)
def test_a_saved_result_tells_what_was_asked_for_and_what_was_chosen(burst, kind, tmp_path):
    result = reconstruct(burst, **{**KINDS[kind], "iterations": 3})
    again = load(result.save(tmp_path / "scene.npz"), device="cpu")
    assert (again.requested, again.settings) == (result.requested, result.settings)
    result.save(tmp_path / "image.ome.tif")
    told = json.loads((tmp_path / "image.json").read_text(encoding="utf-8"))
    assert Settings.from_dict(told["requested"]) == result.requested
    assert Settings.from_dict(told["settings"]) == result.settings
