"""A run that is stopped, paused, turned or continued, and one that breaks."""

import logging
from functools import partial
from itertools import chain, repeat

import numpy as np
import pytest

from napari_fiberburst import Control, reconstruct
from napari_fiberburst.coordinates import in_pixels, relative_to
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.networks.field import JointField
from napari_fiberburst.networks.training import Problem
from napari_fiberburst.settings import choose


def test_stopping_gives_a_usable_result(fit, tiny_burst, same):
    asked = iter([False, False, False, True])
    result = fit(tiny_burst, should_stop=lambda: next(asked))
    assert result.ending == "stopped"
    assert len(result.losses) == 3
    same(result, fit(tiny_burst, iterations=3))


def test_stopping_before_the_first_step_gives_the_start(fit, tiny_burst):
    control = Control()
    control.stop()
    result = fit(tiny_burst, control=control)
    assert len(result.losses) == 0
    assert np.isfinite(result.image).all()
    np.testing.assert_array_equal(result.homographies[0], np.eye(3))
    field = JointField(result.settings.method, tiny_burst.shape, seed=result.settings.seed)
    start = field.motion.scene_from_frame().detach().numpy()
    expected = relative_to(in_pixels(start.astype(np.float64), (31, 37)), 0)
    np.testing.assert_allclose(result.homographies, expected, atol=1e-6)


def test_a_time_budget_ends_the_run(fit, tiny_burst):
    result = fit(tiny_burst, iterations=10**6, time_budget=0.3)
    assert result.ending == "time budget"
    assert 0 < len(result.losses) < 10**6


def test_a_short_budget_leaves_time_for_one_step(fit, tiny_burst):
    assert len(fit(tiny_burst, iterations=50, time_budget=1e-9).losses) == 1


def test_the_time_left_is_that_of_the_budget_where_it_ends_first(fit, tiny_burst):
    reports = []
    fit(tiny_burst, iterations=10**6, time_budget=0.5, on_progress=reports.append)
    assert all(report.remaining <= 0.5 for report in reports)


@pytest.mark.parametrize(
    "choices", [{"time_budget": 0.3}, {"should_stop": partial(next, chain(repeat(False, 21), repeat(True)))}]
)
def test_a_run_that_ends_early_reports_its_end(fit, tiny_burst, choices):
    reports = []
    result = fit(tiny_burst, iterations=10**6, preview_every=1e9, on_progress=reports.append, **choices)
    assert result.ending != "finished"
    assert reports[-1].step == len(result.losses)
    np.testing.assert_array_equal(reports[-1].preview, result.image)


def test_a_paused_run_can_be_stopped_by_its_short_form(fit, tiny_burst):
    control = Control()
    control.pause()
    assert fit(tiny_burst, control=control, should_stop=lambda: True).ending == "stopped"


def test_a_pause_does_not_count_as_time(fit, tiny_burst, monkeypatch):
    now = [0.0]

    def clock():
        now[0] += 0.001
        return now[0]

    class LongPause(Control):
        def wait_while_paused(self, should_stop=None):
            now[0] += 100

    monkeypatch.setattr("napari_fiberburst.pipeline.supervise.time.perf_counter", clock)
    result = fit(tiny_burst, control=LongPause(), time_budget=50.0, iterations=7)
    assert result.ending == "finished"
    assert len(result.losses) == 7
    unpaused = fit(tiny_burst, iterations=7)
    assert result.seconds == pytest.approx(unpaused.seconds, abs=1)  # by that clock, moved on by 700 in the pauses


def test_sigma_and_learning_rate_change_while_it_runs(fit, tiny_burst):
    control = Control()

    def turn(report):
        control.sigma, control.learning_rate = 1.5, 1e-2

    result = fit(tiny_burst, control=control, on_progress=turn)
    assert result.settings.method.encoding.sigma == 1.5
    assert result.settings.method.learning_rate == 1e-2
    assert result.renderer.field.scene.encoding.sigma.item() == 1.5
    assert not np.array_equal(result.image, fit(tiny_burst).image)


def test_a_live_sigma_that_has_no_effect_is_said(fit, tiny_burst, caplog):
    control = Control()
    control.sigma = 2.0
    with caplog.at_level(logging.WARNING):
        fit(tiny_burst, control=control, encoding="nerf")
    assert caplog.messages == ["sigma 2 has no effect: encoding nerf has no frequency spread"]


def test_a_loss_that_is_no_number_ends_the_run_with_the_last_good_state(fit, tiny_burst, caplog):
    with caplog.at_level(logging.WARNING):
        result = fit(tiny_burst, learning_rate=1e6, iterations=400)
    assert result.ending == "diverged"
    assert np.isfinite(result.image).all()
    assert np.isfinite(result.losses).all()
    assert len(result.losses) < 400
    assert "a learning rate lower than 1e+06 may help" in caplog.text


def test_what_broke_a_run_is_not_in_the_settings_it_goes_back_to(fit, tiny_burst):
    control = Control()

    def turn(report):
        control.learning_rate = 1e6

    result = fit(tiny_burst, iterations=2000, control=control, on_progress=turn)
    assert result.ending == "diverged"
    assert result.settings.method.learning_rate == choose("paper").method.learning_rate
    longer = fit(tiny_burst, initial=result, iterations=5)
    assert longer.ending == "finished"


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_a_last_step_that_breaks_the_image_is_taken_back(fit, tiny_burst, monkeypatch, steps):
    step = Problem.step

    def break_at_the_end(self):
        loss = step(self)
        if self.samples.drawn == steps * self.batch:
            for parameter in self.field.scene.parameters():
                parameter.data.fill_(1e30)  # finite, but no image
        return loss

    monkeypatch.setattr(Problem, "step", break_at_the_end)
    result = fit(tiny_burst, iterations=steps)
    assert result.ending == "diverged"
    assert np.isfinite(result.image).all()
    assert np.isfinite(result.frame(1)).all()


def test_a_run_continued_is_the_run_undivided(fit, tiny_burst, same):
    whole = fit(tiny_burst, iterations=30)
    half = fit(tiny_burst, iterations=12)
    image = half.image.copy()
    continued = fit(tiny_burst, iterations=18, initial=half)
    same(continued, whole)
    assert continued.seconds > half.seconds
    np.testing.assert_array_equal(half.render(), image)  # the first half is as it was


def test_a_continued_run_keeps_its_seed(fit, tiny_burst, same):
    half = fit(tiny_burst, seed=5)
    continued = reconstruct(tiny_burst, initial=half, iterations=10)
    assert continued.settings.seed == 5
    same(continued, fit(tiny_burst, seed=5, iterations=20))
    with pytest.raises(SettingsError, match="keeps its seed, 5; got 6"):
        reconstruct(tiny_burst, initial=half, seed=6)


def test_a_spent_budget_is_not_inherited(fit, tiny_burst):
    first = fit(tiny_burst, time_budget=1e-9)
    assert fit(tiny_burst, initial=first, iterations=4).ending == "finished"


def test_a_run_continues_with_its_own_settings(tiny_burst):
    first = reconstruct(tiny_burst, preset="paper", encoding="siren", omega_0=7.0, iterations=2, batch=50, device="cpu")
    assert (
        reconstruct(tiny_burst, initial=first, iterations=1).settings.method.encoding == first.settings.method.encoding
    )


def test_continuing_another_fit_is_refused(fit, tiny_burst):
    first = fit(tiny_burst)
    with pytest.raises(SettingsError, match="continue with networks of the same kind"):
        reconstruct(tiny_burst, initial=first, encoding="nerf")
    with pytest.raises(SettingsError, match="must be a reconstruction of this burst"):
        reconstruct(tiny_burst.crop((0, 20), (0, 20)), initial=first)

    moved = [tiny_burst.crop((a, a + 20), (0, 20)) for a in (0, 5)]
    with pytest.raises(SettingsError, match="must be a reconstruction of this burst"):
        reconstruct(moved[1], initial=fit(moved[0]))
    with pytest.raises(SettingsError, match="must be a Reconstruction"):
        reconstruct(tiny_burst, initial="scene.npz")
