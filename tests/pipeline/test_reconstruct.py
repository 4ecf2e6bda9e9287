"""The run: what it reports, how it ends, what it returns."""

import numpy as np
import pytest
import torch

from napari_fiberburst import Burst, iterate, reconstruct
from napari_fiberburst.errors import BurstError, DeviceError, FiberBurstError, SettingsError
from napari_fiberburst.networks.batches import PixelStream
from napari_fiberburst.networks.training import Problem
from napari_fiberburst.settings import choose
from napari_fiberburst.simulation import simulate


def test_a_run_returns_what_it_promises(fit, tiny_burst):
    result = fit(tiny_burst)
    assert result.image.shape == (31, 37, 3)
    assert result.image.dtype == np.float32
    assert result.homographies.shape == (5, 3, 3)
    assert result.homographies.dtype == np.float64
    np.testing.assert_array_equal(result.homographies[0], np.eye(3))
    assert result.losses.shape == (10,)
    assert np.isfinite(result.losses).all()
    assert result.ending == "finished"
    assert result.device == "cpu"
    assert result.seconds > 0
    assert result.settings.method.iterations == 10


@pytest.mark.parametrize("motion", ["none", "homography", "flow", "flow_tv"])
@pytest.mark.parametrize("encoding", ["none", "nerf", "fourier", "hash", "siren"])
def test_every_motion_runs_with_every_encoding(fit, tiny_burst, motion, encoding):
    result = fit(tiny_burst, motion=motion, encoding=encoding, iterations=40, learning_rate=1e-3)
    assert np.isfinite(result.image).all()
    assert result.losses[-5:].mean() < result.losses[:5].mean()
    if motion != "homography":
        np.testing.assert_array_equal(result.homographies, np.tile(np.eye(3), (5, 1, 1)))


@pytest.mark.parametrize("channels", [1, 3, 7])
def test_any_number_of_channels(fit, rng, channels):
    frames = rng.integers(0, 4096, (3, 17, 23, channels), dtype=np.uint16)
    result = fit(frames)
    assert result.image.shape == (17, 23, channels)
    assert result.frame(1).shape == (17, 23, channels)


def test_a_grey_burst_gives_a_grey_image(fit, rng):
    assert fit(rng.random((3, 17, 23))).image.shape == (17, 23)


def test_the_image_is_in_the_units_of_the_burst(fit, rng):
    frames = rng.normal(3000, 20, (3, 17, 23)).astype(np.float32)
    assert fit(frames, iterations=300, learning_rate=1e-2).image.mean() == pytest.approx(3000, rel=0.01)


def test_the_same_call_twice_gives_the_same_bits_with_threads_at_work(same):
    # Batches large enough for torch to share them out among threads.
    burst = simulate("cat", shape=(97, 129), frames=8, pitch=2.2).burst
    choices = {"preset": "paper", "iterations": 6, "batch": 10_000, "scene_width": 32, "features": 32, "device": "cpu"}
    first = reconstruct(burst, **choices)
    for _ in range(4):
        same(reconstruct(burst, **choices), first)


def test_randomness_of_the_caller_is_left_alone(fit, tiny_burst):
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    fit(tiny_burst)
    assert torch.equal(torch.rand(4), expected)


def test_the_same_call_twice_gives_the_same_bits(fit, tiny_burst, same):
    for choices in ({}, {"motion": "flow_tv"}, {"encoding": "hash"}):
        same(fit(tiny_burst, **choices), fit(tiny_burst, **choices))
    assert not np.array_equal(fit(tiny_burst, seed=1).image, fit(tiny_burst, seed=2).image)


def test_reporting_does_not_change_the_result(fit, tiny_burst, same):
    same(fit(tiny_burst), fit(tiny_burst, on_progress=lambda report: None, preview_every=1e-9))


def test_an_array_a_burst_and_a_path_are_the_same(fit, tiny_burst, tiny_simulation, tmp_path, same):
    arrays = tiny_simulation.arrays()
    np.savez(tmp_path / "burst.npz", **arrays)
    expected = fit(tiny_burst)
    same(fit(arrays["frames"]), expected)
    same(fit(tmp_path / "burst.npz"), expected)
    same(fit(str(tmp_path / "burst.npz")), expected)


def test_it_runs_where_gradients_are_switched_off(fit, tiny_burst, same):
    for switch in (torch.no_grad, torch.inference_mode):
        with switch():
            off = fit(tiny_burst)
        same(off, fit(tiny_burst))


def test_reports_begin_with_the_first_step_and_end_with_the_last(fit, tiny_burst):
    reports = []
    result = fit(tiny_burst, on_progress=reports.append, preview_every=1e-9)
    assert [reports[0].step, reports[-1].step] == [1, 10]
    assert len({report.step for report in reports}) == len(reports)
    assert reports[-1].loss == result.losses[-1]
    np.testing.assert_array_equal(reports[-1].preview, result.image)
    np.testing.assert_array_equal(reports[-1].homographies, result.homographies)
    assert reports[0].remaining is None
    assert reports[-1].remaining == 0
    assert all(isinstance(report.preview, np.ndarray) for report in reports)
    with pytest.raises(AttributeError):
        reports[0].loss = 0


def test_no_previews_are_drawn_unless_asked_for(fit, tiny_burst):
    reports = []
    fit(tiny_burst, on_progress=reports.append)
    assert all(report.preview is None for report in reports)


def test_the_loss_is_the_mean_squared_error_of_its_samples(tiny_burst):
    settings = choose("paper", iterations=1, scene_width=8, motion_width=8, batch=100, device="cpu")
    problem = Problem(tiny_burst, settings.method, torch.device("cpu"))
    batch = PixelStream(tiny_burst, torch.device("cpu"), seed=0).draw(100)
    with torch.no_grad():
        expected = (problem.field(batch.points, batch.frames) - batch.intensities).square().mean()
    assert problem.step() == pytest.approx(expected.item())


def test_a_step_takes_an_eighth_of_a_frame_unless_told(tiny_burst):
    published = Problem(tiny_burst, choose("paper").method, torch.device("cpu"))
    assert published.batch == -(-31 * 37 // 8)
    assert Problem(tiny_burst, choose("paper", batch=7).method, torch.device("cpu")).batch == 7


def test_the_burst_is_left_as_it_was(fit, rng):
    burst = Burst(rng.random((3, 17, 23)))
    before = burst.frames.copy()
    fit(burst)
    np.testing.assert_array_equal(burst.frames, before)


@pytest.mark.parametrize(
    ("choices", "error"),
    [
        ({"device": "cuda:99"}, DeviceError),
        ({"device": "abacus"}, DeviceError),
        ({"preset": "none such"}, SettingsError),
        ({"speed": 9}, SettingsError),
        ({"iterations": 0}, SettingsError),
        ({"bogus": None}, SettingsError),
        ({"control": 3}, SettingsError),
        ({"on_progress": 5}, SettingsError),
        ({"should_stop": True}, SettingsError),
        ({"scene_width": 10**9}, SettingsError),
    ],
)
def test_bad_calls_are_refused(tiny_burst, choices, error):
    with pytest.raises(error) as raised:
        reconstruct(tiny_burst, **choices)
    assert isinstance(raised.value, FiberBurstError)


def test_settings_are_checked_before_the_burst_is_read():
    with pytest.raises(SettingsError):
        reconstruct("no such file.tif", sigma=-1)
    with pytest.raises(BurstError, match="there is no"):
        reconstruct("no such file.tif")


def test_iterate_is_a_generator_that_returns_the_reconstruction(tiny_burst):
    run = iterate(tiny_burst, choose("paper", iterations=2, batch=50, device="cpu"))
    steps = []
    while True:
        try:
            steps.append(next(run).step)
        except StopIteration as end:
            result = end.value
            break
    assert steps == [1, 2]
    assert len(result.losses) == 2


def test_samples_are_every_pixel_once_then_shuffled_anew(tiny_burst):
    samples = PixelStream(tiny_burst, torch.device("cpu"), seed=0)
    total = 5 * 31 * 37
    epochs = [samples.draw(total), samples.draw(total)]
    for batch in epochs:
        x = np.rint((batch.points[:, 0].numpy() + 1) * 37 / 2 - 0.5).astype(int)
        y = np.rint((batch.points[:, 1].numpy() + 1) * 31 / 2 - 0.5).astype(int)
        t = batch.frames.numpy()
        assert len(set(zip(t, y, x, strict=True))) == total
        np.testing.assert_allclose(batch.intensities, 2 * tiny_burst.frames[t, y, x] - 1, atol=1e-6)
    assert not torch.equal(epochs[0].points, epochs[1].points)


def test_samples_go_on_across_the_end_of_an_epoch(tiny_burst):
    device, total = torch.device("cpu"), 5 * 31 * 37
    across = PixelStream(tiny_burst, device, seed=0)
    across.draw(total - 3)
    parts = across.draw(10)
    again = PixelStream(tiny_burst, device, seed=0, drawn=total - 3)
    assert torch.equal(again.draw(3).points, parts.points[:3])
    assert torch.equal(again.draw(7).points, parts.points[3:])
