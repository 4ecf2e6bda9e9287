"""The self-calibrating fit against the truth."""

import numpy as np
import pytest
import torch

from napari_fiberburst import Burst, Control, load, reconstruct
from napari_fiberburst.errors import BundleError, SettingsError
from napari_fiberburst.quality import motion_error, psnr, ssim
from napari_fiberburst.simulation import Camera, Faults, simulate

SHAPE = (127, 141)


@pytest.mark.parametrize(
    ("scene", "physics", "pitch", "least", "alike", "most_motion"),
    [
        ("histology", "core", 6.0, 28.0, 0.80, 0.1),
        ("histology", "mask", 5.0, 34.0, 0.97, 0.1),
        ("cat", "core", 4.0, 29.0, 0.80, 0.1),
        ("retina", "mask", 7.0, 40.0, 0.97, 0.5),
        ("tissue", "core", 6.0, 22.0, 0.85, 0.15),
    ],
)
def test_images_and_motion_come_close_to_the_truth(scene, physics, pitch, least, alike, most_motion):
    simulated = simulate(scene, shape=SHAPE, frames=16, pitch=pitch, physics=physics, seed=11)
    result = reconstruct(simulated.burst, fill=True)
    truth = simulated.truth[0]
    assert psnr(result.image, truth) > least
    assert ssim(result.image, truth) > alike
    assert motion_error(result.homographies, simulated.homographies, SHAPE) < most_motion
    assert result.frames_used == tuple(range(16))
    assert result.notes == ()


def test_it_comes_as_close_as_knowing_the_bundle(cores, fitted):
    known = reconstruct(cores.burst, calibration=cores.transmission * 255, fill=True)
    truth = cores.truth[0]
    assert psnr(fitted.image, truth) > psnr(known.image, truth) - 0.5


def test_what_is_known_comes_with_the_image(cores, fitted):
    count = len(fitted.bundle.centres)
    assert fitted.coverage.shape == fitted.uncertainty.shape == SHAPE
    assert fitted.bundle.transmission.shape == SHAPE
    assert fitted.residuals.shape == (12, count)
    assert fitted.bundle.pitch == pytest.approx(6, rel=0.03)
    assert abs(count / len(cores.bundle.centres) - 1) < 0.05
    assert (fitted.confidence > 0.8).all()
    assert 2 < fitted.resolution < 12
    # Off frame 0's own view coverage falls; about the middle all frames have looked.
    per_pixel = count * 12 * np.pi * fitted.bundle.radius**2 / np.prod(SHAPE)
    assert np.median(fitted.coverage) == pytest.approx(per_pixel, rel=0.4)
    # Samples that the scene was solved from are missed by less than those left out, and both by about the noise.
    assert 1 < fitted.held_out_rmse / np.sqrt(np.nanmean(fitted.residuals**2)) < 2


def test_uncertainty_is_of_the_size_of_the_noise(cores, fitted):
    """Two cameras' noise on the same object: their images differ by what uncertainty says, about."""
    other = simulate("histology", shape=SHAPE, frames=12, pitch=6.0, physics="core", seed=3, camera=Camera(photons=700))
    noisy = reconstruct(other.burst, fill=True)
    assert np.median(noisy.uncertainty) > np.median(fitted.uncertainty)
    inner = (slice(20, -20), slice(20, -20))
    missed = fitted.image[inner] / 255 - cores.truth[0][inner]
    missed = (missed - missed.mean(axis=(0, 1))).std()
    assert 0.1 < np.median(fitted.uncertainty[inner]) / 255 / missed < 3


@pytest.fixture(scope="module")
def twice(cores):
    """Return what `fitted` is once more, and the reports of progress on the way."""
    reports = []
    return reconstruct(cores.burst, fill=True, preview_every=1e-9, on_progress=reports.append), reports


def test_the_same_call_twice_gives_the_same_bits(fitted, twice):
    np.testing.assert_array_equal(twice[0].image, fitted.image)
    np.testing.assert_array_equal(twice[0].homographies, fitted.homographies)


def test_previews_begin_early_and_get_better(cores, twice):
    result, reports = twice
    previews = [report for report in reports if report.preview is not None]
    quality = [psnr(report.preview, cores.truth[0]) for report in previews]
    assert len(previews) >= 4
    # The first is of a frame by itself, before any frame has moved.
    np.testing.assert_array_equal(previews[0].homographies, np.tile(np.eye(3), (len(previews[0].homographies), 1, 1)))
    assert quality[0] > 15
    assert previews[1].step < 0.6 * reports[-1].step
    assert quality[-1] == max(quality)
    errors = [motion_error(report.homographies, cores.homographies, SHAPE) for report in previews]
    assert errors[-1] < 0.3 * errors[0] + 0.05
    assert reports[-1].held_out_rmse == result.held_out_rmse
    assert reports[-1].step == reports[-1].iterations


@pytest.mark.parametrize(
    "faults",
    [
        Faults(deformation=3.0, flicker=0.05, intruder=0.05, smear=1.0),
        Faults(vignette=3.0, field=0.9, overlay=True, bundle_shift=1.0),
    ],
)
def test_the_same_bits_with_any_number_of_threads(faults, same):
    # Large enough for torch to share sums, products and transforms out among threads.
    burst = simulate("histology", shape=(191, 207), frames=8, physics="core", pitch=4.3, faults=faults, seed=4).burst
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(reconstruct(burst))
    finally:
        torch.set_num_threads(before)
    for result in results[1:]:
        same(result, results[0])
        np.testing.assert_array_equal(result.uncertainty, results[0].uncertainty)
        assert result.quality == results[0].quality


def test_a_saved_scene_draws_the_same_again(cores, fitted, tmp_path):
    fitted.save(tmp_path / "scene.npz")
    again = load(tmp_path / "scene.npz")
    np.testing.assert_array_equal(again.image, fitted.image)
    assert again.notes == fitted.notes
    assert again.frames_used == fitted.frames_used
    np.testing.assert_allclose(again.frame(5), fitted.frame(5))
    fitted.save(tmp_path / "image.ome.tif")


def test_frames_are_drawn_as_they_see_the_scene(cores, fitted):
    for number in (3, 9):
        drawn = fitted.frame(number)
        seen = np.isfinite(drawn).all(axis=2)
        assert seen.mean() > 0.6
        assert psnr(drawn[seen][None], cores.truth[number][seen][None]) > 23


@pytest.mark.parametrize("motion", ["translation", "similarity", "affine"])
def test_a_simpler_motion_is_kept_to(cores, motion):
    result = reconstruct(cores.burst, motion=motion, iterations=4)
    for matrix in result.homographies[1:]:
        np.testing.assert_allclose(matrix[2], [0, 0, 1], atol=1e-6)
        if motion != "affine":
            square = matrix[:2, :2].T @ matrix[:2, :2]
            np.testing.assert_allclose(square, square[0, 0] * np.eye(2), atol=1e-6)
        if motion == "translation":
            np.testing.assert_allclose(matrix[:2, :2], np.eye(2), atol=1e-9)


def test_the_union_shows_what_other_frames_saw(cores):
    result = reconstruct(cores.burst, canvas="union", upsample=2)
    height, width = result.image.shape[:2]
    assert height > 2 * SHAPE[0]
    assert width > 2 * SHAPE[1]
    assert result.coverage.shape == (height, width)
    unseen = np.isnan(result.image[..., 0])
    assert unseen.any()
    assert not result.coverage[unseen].any()
    points = result.canvas.points()
    seen = cores.scene.sample(points)
    usable = ~unseen & (result.coverage > 3)
    flat = [part[usable] for part in (result.image / 255, seen)]
    assert np.corrcoef(flat[0].ravel(), flat[1].ravel())[0, 1] > 0.9


def test_smoothness_can_be_fixed(cores, fitted):
    smooth = reconstruct(cores.burst, smoothness=10.0, fill=True)
    assert fitted.settings.method.smoothness < 1
    assert smooth.settings.method.smoothness == 10.0
    assert np.abs(np.diff(fitted.image, axis=0)).mean() > 1.5 * np.abs(np.diff(smooth.image, axis=0)).mean()


@pytest.mark.parametrize("encoding", ["fourier", "hash", "siren", "nerf", "none"])
def test_networks_run_on_the_same_samples(encoding):
    simulated = simulate("cat", shape=(67, 81), frames=6, pitch=5.0, physics="core", seed=2)
    small = {"scene_width": 32, "scene_layers": 2, "batch": 256}
    result = reconstruct(simulated.burst, encoding=encoding, iterations=40, fill=True, **small)
    assert result.image.shape == (67, 81, 3)
    assert np.isfinite(result.image).all()
    assert result.held_out_rmse > 0
    assert result.coverage.shape == (67, 81)
    # The registration it starts from is kept, or bettered.
    assert motion_error(result.homographies, simulated.homographies, (67, 81)) < 0.6
    if encoding == "fourier":
        assert result.settings.method.encoding.sigma == pytest.approx(0.3 * 81 / 2 / 5, rel=0.1)


def test_a_network_ends_where_it_stops_meeting_unseen_samples_better(monkeypatch):
    simulated = simulate("cat", shape=(67, 81), frames=6, pitch=5.0, physics="core", seed=2)
    monkeypatch.setattr("napari_fiberburst.pipeline.network._LEAST_PATIENCE", 20)
    small = {"scene_width": 8, "scene_layers": 1, "levels": 6, "batch": 96, "learning_rate": 0.1}
    result = reconstruct(simulated.burst, encoding="hash", **small)
    assert result.ending == "finished"
    assert len(result.losses) < 2000
    # It overfits later: the last losses are lower than those of the state that was kept.
    assert result.held_out_rmse > 0


def test_flow_starts_from_the_registration():
    simulated = simulate("cat", shape=(67, 81), frames=6, pitch=5.0, physics="core", seed=2)
    result = reconstruct(simulated.burst, encoding="fourier", motion="flow", iterations=3, motion_width=16, batch=256)
    assert motion_error(result.homographies, simulated.homographies, (67, 81)) < 0.6


@pytest.mark.parametrize("rounds", [3, 9, 16, 27, 30])
def test_wherever_it_is_stopped_image_and_motion_belong_together(cores, rounds, tmp_path):
    control = Control()
    result = reconstruct(
        cores.burst, control=control, on_progress=lambda report: report.step >= rounds and control.stop()
    )
    assert result.ending == "stopped"
    result.save(tmp_path / "scene.npz")
    again = load(tmp_path / "scene.npz")
    np.testing.assert_array_equal(again.homographies, result.homographies)
    np.testing.assert_array_equal(again.image, result.image)
    assert any("before the frames were registered" in note for note in result.notes) == (rounds < 20)


def test_a_network_cut_short_still_has_its_colours(cores):
    small = {"encoding": "fourier", "scene_width": 32, "scene_layers": 2, "features": 32, "batch": 512}
    result = reconstruct(cores.burst, time_budget=0.8, fill=True, **small)
    levels = cores.truth[0].mean(axis=(0, 1))
    assert np.ptp(result.image.mean(axis=(0, 1))) > 0.3 * np.ptp(levels) * 255


def test_rounds_can_be_limited(cores, fitted):
    quick = reconstruct(cores.burst, iterations=2, fill=True)
    assert len(quick.losses) < len(fitted.losses)
    assert (quick.confidence > 0.5).all()
    assert quick.held_out_rmse < 5 * fitted.held_out_rmse


def test_very_dim_recordings_do_as_well(cores, fitted):
    frames = cores.arrays()["frames"].astype(np.uint32) * 300
    result = reconstruct(Burst(frames, axes="TYXC"), fill=True)
    assert psnr(result.image, cores.truth[0]) > psnr(fitted.image, cores.truth[0]) - 0.5


def test_a_calibration_image_of_something_else_is_refused(cores):
    with pytest.raises(BundleError, match="shows no bundle"):
        reconstruct(cores.burst, calibration=np.full(SHAPE, 200.0))


def test_a_calibration_image_may_be_grey_or_in_colour(cores):
    grey = cores.transmission * 200
    colour = np.repeat(grey[..., None], 3, axis=2)
    first, second = (reconstruct(cores.burst, calibration=image, fill=True, iterations=1) for image in (grey, colour))
    np.testing.assert_allclose(first.image, second.image, atol=0.5)


def test_it_can_be_stopped_and_run_out_of_time(cores):
    control = Control()
    stopped = reconstruct(cores.burst, control=control, on_progress=lambda report: report.step >= 5 and control.stop())
    assert stopped.ending == "stopped"
    assert np.isfinite(stopped.image).any()
    hurried = reconstruct(cores.burst, time_budget=0.01)
    assert hurried.ending == "time budget"
    assert hurried.image.shape == (*SHAPE, 3)


def test_a_spline_has_nothing_to_continue(cores, fitted):
    with pytest.raises(SettingsError, match="nothing to continue"):
        reconstruct(cores.burst, initial=fitted)


def test_progress_tells_what_was_chosen(tiny_burst):
    reports = []
    small = {"scene_width": 8, "scene_layers": 1, "features": 8, "iterations": 3}
    result = reconstruct(tiny_burst, encoding="fourier", **small, on_progress=reports.append)
    assert reports[0].settings.method.encoding.sigma is None
    assert reports[-1].settings == result.settings
    assert result.settings.method.encoding.sigma > 0
    assert reports[-1].canvas.shape == result.canvas.shape
