"""A scene can be solved again at another smoothness, or without some frames, and comes to what a run comes to."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from napari_fiberburst import Reconstruction, calibrate, load, reconstruct, register, sample, solve
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.results.diagnostics import Diagnostics
from napari_fiberburst.settings import Settings

OUT = (3, 7)


def assert_alike(first: Reconstruction, second: Reconstruction) -> None:
    """Assert that two results have the same image and evidence, to the bit."""
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.homographies, second.homographies)
    assert first.settings == second.settings
    for item in fields(Diagnostics):
        one, other = getattr(first, item.name), getattr(second, item.name)
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other, err_msg=item.name)
        elif item.name not in ("bundle", "agreement"):
            assert one == other, item.name


@pytest.fixture(scope="module")
def run(cores):
    return reconstruct(cores.burst)


def test_with_nothing_turned_it_comes_to_the_same_bits(run):
    assert_alike(run.solve_again(), run)


def test_another_smoothness_is_what_a_run_with_it_comes_to(cores, run):
    again = run.solve_again(smoothness=0.5)
    assert again.settings.value_of("smoothness") == again.requested.value_of("smoothness") == 0.5
    assert again.held_out_rmse != run.held_out_rmse
    assert again.uncertainty.mean() < run.uncertainty.mean()
    assert again.resolution == run.resolution, "what halves of the burst agree on does not depend on it"
    assert_alike(again, reconstruct(cores.burst, preset=again.requested))


def test_it_goes_back_from_wherever_it_was_turned_to(run):
    turned = run.solve_again(smoothness=2.0, leave_out=OUT)
    assert_alike(turned.solve_again(), run)


def test_frames_left_out_by_hand_are_what_a_run_without_them_comes_to(cores, run):
    again = run.solve_again(leave_out=OUT)
    assert again.frames_used == tuple(frame for frame in range(12) if frame not in OUT)
    assert np.isfinite(again.homographies).all(), "they are registered all the same"
    assert np.isnan(again.exposures[list(OUT)]).all()
    assert np.isnan(again.residuals[list(OUT)]).all()
    assert again.context.max() <= 10
    assert again.coverage.sum() < run.coverage.sum()
    assert "left out by hand: frames 3, 7" in again.notes
    assert not any("could be registered" in note for note in again.notes)
    assert Settings.from_dict(again.provenance()["settings"]) == again.settings
    assert_alike(again, reconstruct(cores.burst, leave_out=OUT))


def test_what_frames_show_that_are_left_out_has_no_part_in_the_scene(cores):
    bundle = calibrate(cores.burst)
    samples = sample(cores.burst, bundle)
    registration = register(samples)
    noise = torch.rand(samples.values.shape, generator=torch.Generator().manual_seed(0))
    gone = torch.zeros(12, 1, 1, dtype=torch.bool)
    gone[list(OUT)] = True
    other = replace(samples, values=torch.where(gone, noise, samples.values))
    first, second = (solve(each, registration.without(OUT)) for each in (samples, other))
    assert torch.equal(first.coefficients, second.coefficients)
    assert first.held_out_rmse == second.held_out_rmse

    # A burst that never had them comes to the same scene; which samples are left out depends on the number of frames.
    left = [frame for frame in range(12) if frame not in OUT]
    parts = ("scene_from_frame", "used", "confidence", "frame_weights", "exposures")
    fewer = replace(registration, **{name: getattr(registration, name)[left] for name in parts})
    short = replace(samples, values=samples.values[left], weights=samples.weights[left])
    alone = solve(short, fewer, first.grid, held_out=0.0)
    whole = solve(samples, registration.without(OUT), first.grid, held_out=0.0)
    assert alone.smoothness == whole.smoothness
    torch.testing.assert_close(alone.coefficients, whole.coefficients, rtol=0, atol=1e-5)


def test_the_image_keeps_its_place_without_its_reference_frame(run):
    again = run.solve_again(leave_out=(0,))
    assert again.reference == run.reference == 0
    np.testing.assert_array_equal(again.homographies, run.homographies)
    known = np.isfinite(again.image) & np.isfinite(run.image)
    assert np.corrcoef(again.image[known], run.image[known])[0, 1] > 0.99


def test_a_single_frame_may_be_left(run):
    again = run.solve_again(leave_out=range(1, 12))
    assert again.frames_used == (0,)
    assert np.isfinite(again.image).mean() > 0.9


@pytest.mark.parametrize("choices", [{"smoothness": 0.2}, {"leave_out": OUT}, {"smoothness": 0.2, "leave_out": OUT}])
def test_a_look_shows_what_solving_will_come_to(run, choices):
    look = run.solver.look()
    look.image(smoothness=5.0)  # wherever it was before
    choices = {"smoothness": run.settings.value_of("smoothness"), **choices}
    image, canvas = look.image(**choices)
    solved = run.solve_again(**choices)
    assert canvas.shape == solved.canvas.shape
    known = np.isfinite(solved.image)
    np.testing.assert_array_equal(np.isfinite(image), known)
    off = np.sqrt(np.mean((image - solved.image)[known] ** 2))
    changed = np.sqrt(np.nanmean((solved.image - run.image) ** 2))
    assert off < 0.2 * changed


def test_nothing_is_solved_again_where_nothing_was_solved(cores, run, fit, tiny_burst, tmp_path):
    stopped = reconstruct(cores.burst, should_stop=lambda: True)
    loaded = load(run.save(tmp_path / "run.npz"))
    for result in (stopped, loaded, fit(tiny_burst)):
        with pytest.raises(SettingsError, match="run the burst anew"):
            result.solve_again(smoothness=1.0)


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"smoothness": 0.0}, "smoothness must be a number above 0"),
        ({"leave_out": (-1,)}, "leave_out must be a tuple of frame numbers"),
        ({"leave_out": (12,)}, "numbers from 0 to 11"),
        ({"leave_out": range(12)}, "at least one registered frame must take part"),
    ],
)
def test_what_cannot_be_is_refused(run, choices, words):
    with pytest.raises(SettingsError, match=words):
        run.solve_again(**choices)
