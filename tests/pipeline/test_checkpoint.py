"""A fit of networks that was killed goes on from its checkpoint, to the bits that it would have come to."""

import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from napari_fiberburst import Control, FiberBurstError, reconstruct
from napari_fiberburst.errors import OutputError
from napari_fiberburst.networks.training import Problem
from napari_fiberburst.pipeline.checkpoint import Checkpoint
from napari_fiberburst.simulation import simulate

SMALL = {"scene_width": 16, "scene_layers": 2, "batch": 256}
METHODS = {
    "network": {"encoding": "fourier", "iterations": 40, "features": 16, **SMALL},
    "grid": {"encoding": "hash", "iterations": 40, "held_out": 0.1, "levels": 8, **SMALL},
    "paper": {"preset": "paper", "iterations": 40, "batch": 500},
}


class KilledError(Exception):
    """Ends a run without its knowledge."""


@pytest.fixture(scope="module")
def burst():
    return simulate("histology", shape=(45, 52), frames=6, pitch=4.0, physics="core", seed=2).burst


@pytest.fixture(scope="module")
def whole(burst):
    """Return a function that gives what a method comes to where nothing ends its run."""
    return cache(lambda method: reconstruct(burst, **METHODS[method]))


def once_kept(path, step, end):
    """Return a report of progress that ends a run once its checkpoint tells of so many steps."""

    def report(progress):
        if path.exists() and Checkpoint.load(path).now.step >= step:
            end()

    return report


def killed():
    raise KilledError


def run_until_killed(burst, path, choices, step):
    with pytest.raises(KilledError):
        reconstruct(burst, **choices, checkpoint=path, checkpoint_every=1e-9, on_progress=once_kept(path, step, killed))


@pytest.fixture(scope="module")
def left_behind(burst, tmp_path_factory):
    """Return the checkpoint of a run that was killed; it is not to be written to."""
    path = tmp_path_factory.mktemp("killed") / "run.checkpoint"
    run_until_killed(burst, path, METHODS["network"], 5)
    return path


@pytest.fixture
def kept(left_behind, tmp_path):
    """Return a checkpoint of a run that was killed, for this test alone."""
    return shutil.copy(left_behind, tmp_path / "run.checkpoint")


@pytest.mark.parametrize("method", METHODS)
def test_a_killed_run_goes_on_to_the_same_bits(burst, whole, tmp_path, method, same, monkeypatch):
    path, choices, expected = tmp_path / "run.checkpoint", METHODS[method], whole(method)
    for step in (3, 22):
        run_until_killed(burst, path, choices, step)
    left, step_once = [], Problem.step
    monkeypatch.setattr(Problem, "step", lambda problem: left.append(1) or step_once(problem))
    gone_on = reconstruct(burst, **choices, checkpoint=path)
    same(gone_on, expected)
    assert len(left) <= len(expected.losses) - 22
    assert gone_on.seconds > Checkpoint.load(path).seconds
    assert gone_on.held_out_rmse == expected.held_out_rmse


def test_a_stopped_run_is_kept_where_it_stopped(burst, whole, tmp_path, same):
    path, control = tmp_path / "run.checkpoint", Control()
    choices = {**METHODS["network"], "checkpoint": path}
    stopped = reconstruct(
        burst, **choices, checkpoint_every=1e-9, on_progress=once_kept(path, 9, control.stop), control=control
    )
    assert stopped.ending == "stopped"
    assert Checkpoint.load(path).now.step == len(stopped.losses)
    same(reconstruct(burst, **choices), whole("network"))


def test_a_disk_that_is_full_does_not_end_the_run(burst, whole, tmp_path, monkeypatch, caplog, same):
    path, save, tries = tmp_path / "run.checkpoint", Checkpoint.save, []

    def full(checkpoint, path):
        tries.append(checkpoint.now.step)
        if len(tries) > 1:
            raise OutputError(f"{path} cannot be written (No space left on device); choose another place")
        return save(checkpoint, path)

    monkeypatch.setattr(Checkpoint, "save", full)
    same(reconstruct(burst, **METHODS["network"], checkpoint=path, checkpoint_every=1e-9), whole("network"))
    assert Checkpoint.load(path).now.step == tries[0]
    assert f"the run goes on, but could not be kept: {path} cannot be written" in caplog.text


def test_a_rate_that_was_changed_meanwhile_stays(burst, kept):
    found = Checkpoint.load(kept)
    settings = found.now.method
    method = {**settings["method"], "learning_rate": 1e-5}
    replace(found, now=replace(found.now, method={**settings, "method": method})).save(kept)
    gone_on = reconstruct(burst, **METHODS["network"], checkpoint=kept)
    assert gone_on.settings.method.learning_rate == 1e-5
    np.testing.assert_allclose(gone_on.losses[found.now.step :].std(), 0, atol=gone_on.losses[: found.now.step].std())


@pytest.mark.parametrize(
    ("change", "named"),
    [({"seed": 1}, "settings"), ({"iterations": 41}, "settings"), ({"preset": "paper"}, "settings")],
)
def test_a_checkpoint_of_other_settings_is_refused(burst, kept, change, named):
    choices = {**METHODS["network"], **change} if "preset" not in change else change
    before = kept.read_bytes()
    with pytest.raises(FiberBurstError, match=rf"checkpoint of another run \(not the same: {named}\)"):
        reconstruct(burst, **choices, checkpoint=kept)
    assert kept.read_bytes() == before


def test_a_checkpoint_of_another_burst_is_refused(kept):
    other = simulate("histology", shape=(45, 52), frames=6, pitch=4.0, physics="core", seed=3).burst
    with pytest.raises(FiberBurstError, match="not the same: burst"):
        reconstruct(other, **METHODS["network"], checkpoint=kept)


def test_time_budget_and_device_may_be_others(burst, kept):
    assert (
        reconstruct(burst, **METHODS["network"], checkpoint=kept, time_budget=1000.0, device="cpu").ending == "finished"
    )


@pytest.mark.parametrize("part", ["now", "best"])
def test_arrays_of_other_networks_are_refused(burst, kept, part):
    found = Checkpoint.load(kept)
    state = getattr(found, part)
    arrays = state.arrays
    name = sorted(arrays)[0]
    for changed in (
        {**arrays, name: np.zeros((3, 3), np.float32)},
        {key: arrays[key] for key in arrays if key != name},
    ):
        replace(found, **{part: replace(state, arrays=changed)}).save(kept)
        with pytest.raises(FiberBurstError, match="does not belong to this run"):
            reconstruct(burst, **METHODS["network"], checkpoint=kept)


@pytest.mark.parametrize(
    "change",
    [
        lambda found: {"now": replace(found.now, step=-1)},
        lambda found: {"best": replace(found.best, drawn=-1)},
        lambda found: {"losses": np.zeros(2, np.float32)},
        lambda found: {"seconds": np.inf},
        lambda found: {"best_error": None},
        lambda found: {"run": 3},
        lambda found: {"command": 3},
    ],
)
def test_values_that_do_not_belong_together_are_refused(kept, change):
    found = Checkpoint.load(kept)
    replace(found, **change(found)).save(kept)
    with pytest.raises(FiberBurstError, match="holds no complete checkpoint"):
        Checkpoint.load(kept)


def test_a_damaged_checkpoint_is_refused(burst, kept):
    told = bytearray(kept.read_bytes())
    told[len(told) // 2] ^= 1
    kept.write_bytes(told)
    with pytest.raises(FiberBurstError, match=r"run\.checkpoint"):
        reconstruct(burst, **METHODS["network"], checkpoint=kept)


def test_what_has_no_checkpoint_says_so(burst, tmp_path):
    with pytest.raises(FiberBurstError, match="a spline is solved in seconds"):
        reconstruct(burst, checkpoint=tmp_path / "run.checkpoint")
    with pytest.raises(FiberBurstError, match=r"written to a file ending in \.checkpoint"):
        reconstruct(burst, preset="paper", checkpoint=tmp_path / "run.npz")
    with pytest.raises(FiberBurstError, match="positive number of seconds"):
        reconstruct(burst, preset="paper", checkpoint=tmp_path / "run.checkpoint", checkpoint_every=0)
