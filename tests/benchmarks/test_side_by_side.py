"""A change beside the checkout from before it: the same code costs nothing, worse images are refused."""

import sys

import numpy as np
import pytest
from benchmarks.cases import Case
from benchmarks.side_by_side import HERE, Pair

from benchmarks import side_by_side
from napari_fiberburst.errors import FiberBurstError, SettingsError

TINY = Case(name="tiny", scene="cat", side=48, pitch=4.0, frames=4, seed=3)


def call(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["side_by_side", *map(str, arguments)])
    return side_by_side.main()


def test_the_same_checkout_loses_nothing(monkeypatch, capsys):
    monkeypatch.setattr(side_by_side, "find", lambda names, *, is_quick: {"1:tiny": TINY})
    assert call(monkeypatch, HERE, "--repeats", 1, "--device", "cpu", "--most-time", 1000) == 0
    row, summary = capsys.readouterr().out.splitlines()[1:]
    name, before, after, difference, *times = row.split()
    assert (name, before, difference) == ("1:tiny", after, "+0.000")
    assert float(before) > 10
    assert len(times) == 3
    assert "worst difference +0.000 dB (1:tiny)" in summary
    assert "within the limits of 0.1 dB and 1000 x" in summary


@pytest.mark.parametrize(
    ("quality", "seconds", "status"),
    [
        ([(30.0, 30.5), (30.0, 29.95)], [(2.0, 2.1), (2.0, 1.0)], 0),
        ([(30.0, 30.5), (30.0, 29.8)], [(2.0, 2.0), (2.0, 2.0)], 1),
        ([(30.0, 30.0), (30.0, 30.0)], [(2.0, 2.6), (2.0, 2.4)], 1),
    ],
)
def test_a_loss_or_slower_fits_are_the_exit_status(quality, seconds, status, monkeypatch, capsys):
    pairs = iter([Pair(name=f"burst {n}", quality=quality[n], seconds=seconds[n]) for n in range(2)])
    monkeypatch.setattr(side_by_side, "find", lambda names, *, is_quick: {"1:tiny": TINY, "3:tiny": TINY})
    monkeypatch.setattr(side_by_side, "compare", lambda trial, other, repeats: next(pairs))
    assert call(monkeypatch, HERE) == status
    assert ("beyond" if status else "within") in capsys.readouterr().out.splitlines()[-1]


def test_cases_are_found_by_table_and_name():
    assert list(side_by_side.find(["3:by hand", "1"], is_quick=False))[:2] == ["3:by hand", "1:liver"]
    assert len(side_by_side.find(None, is_quick=True)) == 8
    with pytest.raises(SettingsError, match="unknown case 'moon'; known: 1, 3, 5, 6, 1:liver"):
        side_by_side.find(["moon"], is_quick=False)


def test_a_folder_without_the_package_is_refused(tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, tmp_path) == 2
    assert f"expected a checkout with src/napari_fiberburst in {tmp_path}" in capsys.readouterr().err


def test_a_fit_that_fails_is_named(tmp_path):
    source = tmp_path / "burst.npz"
    black = np.zeros((3, 31, 37, 1), np.uint8)
    np.savez(source, frames=black, black_level=0, white_level=255, scale=1, device="cpu")
    with pytest.raises(FiberBurstError, match=r"the fit by .* failed: .*every frame is constant"):
        side_by_side.fitted(HERE, source)


def test_the_package_of_another_folder_is_no_answer(tmp_path):
    trial = side_by_side.simulated("tiny", TINY, "cpu")
    source = tmp_path / "burst.npz"
    np.savez(source, **trial.inputs)
    with pytest.raises(FiberBurstError, match="expected the package of"):
        side_by_side.fitted(tmp_path, source)


def test_the_real_burst_is_judged_by_the_finest_bars(monkeypatch):
    real = side_by_side.RealBurst(
        frames=np.zeros((2, 31, 37), np.uint8), background=np.zeros((31, 37), np.uint8), device="cpu"
    )
    rows = [{"group": 6, "modulation": 0.9}, {"group": 7, "modulation": 0.4}, {"group": 7, "modulation": 0.6}]
    monkeypatch.setattr(side_by_side.Shown, "elements", lambda shown: iter(rows))
    trial = side_by_side.recorded(real)
    assert trial.quality(np.zeros((62, 74), np.float32)) == pytest.approx(20 * np.log10(0.5))
    assert trial.inputs["frames"].shape == (2, 31, 37, 1)
