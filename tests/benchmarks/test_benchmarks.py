"""The benchmark: its folder of rows, its methods, its reading of the chart; and what it says to bad calls."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.cases import Case
from benchmarks.chart import PLACES, Shown, period_of
from benchmarks.compare import compare, score
from benchmarks.methods import METHODS, Effort, PeerError
from benchmarks.recorded import measure_recorded
from benchmarks.results import (
    CONDITIONS,
    MACHINE,
    RECORDED,
    SCENES,
    Recorder,
    Results,
    with_earlier,
    write_start_curves,
)

from benchmarks import __main__ as command
from benchmarks import cases, chart, methods, publish, published_start, report, results
from napari_fiberburst.errors import BurstError, OutputError, SettingsError
from napari_fiberburst.quality import psnr
from napari_fiberburst.results.reconstruction import Canvas

SMALL = Case(name="small", scene="cat", side=80, pitch=4.0, frames=6, seed=3)


def test_a_killed_run_goes_on_where_it_was(tmp_path):
    computed = []

    def compute(number):
        computed.append(number)
        return {"psnr": float(number)}

    with Recorder(tmp_path, "quick") as first:
        for number in range(3):
            first.row(SCENES, f"case {number}", "default", lambda number=number: compute(number))
    with Recorder(tmp_path, "quick", resume=True) as again:
        for number in range(5):
            row = again.row(SCENES, f"case {number}", "default", lambda number=number: compute(number))
            assert row["psnr"] == number
    assert computed == [0, 1, 2, 3, 4]
    assert [row["case"] for row in again.results.rows(SCENES)] == [f"case {number}" for number in range(5)]


def test_a_row_that_was_cut_off_is_dropped_with_a_word_and_measured_again(tmp_path, capsys):
    with Recorder(tmp_path, "quick") as first:
        for case in ("a", "b"):
            first.row(SCENES, case, "default", lambda: {"psnr": 1.0})
    path = first.results.rows_file(SCENES)
    whole = path.read_bytes()
    path.write_bytes(whole[:-9])
    assert [row["case"] for row in Results(tmp_path).rows(SCENES)] == ["a"]
    with Recorder(tmp_path, "quick", resume=True) as again:
        assert f"dropped the last line of {path}" in capsys.readouterr().out
        for case in ("a", "b"):
            again.row(SCENES, case, "default", lambda: {"psnr": 2.0})
    assert [(row["case"], row["psnr"]) for row in again.results.rows(SCENES)] == [("a", 1.0), ("b", 2.0)]


def test_a_row_that_is_done_is_in_the_file_before_the_next_begins(tmp_path):
    with Recorder(tmp_path, "quick") as recorder:
        recorder.row(SCENES, "a", "default", lambda: {"psnr": 1.0})
        seen = []
        recorder.row(SCENES, "b", "default", lambda: seen.extend(Results(tmp_path).rows(SCENES)) or {"psnr": 2.0})
    assert [row["case"] for row in seen] == ["a"]


def test_a_line_that_is_no_row_is_named(tmp_path):
    with Recorder(tmp_path, "quick") as recorder:
        recorder.row(SCENES, "a", "default", lambda: {"psnr": 1.0})
    path = recorder.results.rows_file(SCENES)
    path.write_bytes(path.read_bytes() + b'{"psnr": 3}\n')
    with pytest.raises(OutputError, match=r"line 2 of .*1_scenes\.jsonl is no row: expected a JSON object with case"):
        recorder.results.rows(SCENES)


def test_one_run_at_a_time_writes_into_a_folder(tmp_path):
    with Recorder(tmp_path, "quick"), pytest.raises(OutputError, match="another run is writing into"):
        Recorder(tmp_path, "quick", resume=True)
    with Recorder(tmp_path, "quick", resume=True) as later:
        assert later.row(SCENES, "a", "default", lambda: {"psnr": 1.0})["psnr"] == 1


def test_results_are_not_overwritten_unasked(tmp_path):
    with Recorder(tmp_path, "quick") as recorder:
        recorder.row(SCENES, "a", "default", lambda: {"psnr": 1.0, "image": np.zeros((5, 7))})
    with pytest.raises(OutputError, match=r"--resume goes on with them, --overwrite"):
        Recorder(tmp_path, "quick")
    with pytest.raises(OutputError, match="name another folder"):
        Recorder(tmp_path, "full", resume=True)
    with Recorder(tmp_path, "full", overwrite=True) as emptied:
        left = emptied.results
    assert left.rows(SCENES) == []
    assert left.image(SCENES, "a", "default") is None
    assert left.about["mode"] == "full"


def test_every_row_says_where_it_came_from(tmp_path):
    with Recorder(tmp_path, "quick") as recorder:
        compare(recorder, CONDITIONS, [SMALL], ["captured", "gaussian-fixed"], Effort(), images=False)
    for row in recorder.results.rows(CONDITIONS):
        assert row["burst"]["seed"] == 3
        assert row["date"] >= "2026"
        assert "commit" in row
    assert {"torch", "numpy"} <= set(recorder.results.about["versions"])


def test_rows_of_another_machine_are_said_to_be_so(tmp_path, monkeypatch):
    with Recorder(tmp_path, "quick") as recorder:
        machine = recorder.results.about["processor"]
    measured = results.describe_machine()
    monkeypatch.setattr(results, "describe_machine", lambda: {**measured, "processor": "an abacus"})
    for _ in range(2):
        with Recorder(tmp_path, "quick", resume=True) as later:
            text = report.in_markdown(later.results)
        assert "an abacus" in text.split("Rows before")[0]
        assert machine in text.split("Rows before")[1]
        assert text.count("Rows before") == 1


def test_a_peer_that_is_missing_has_its_row(tmp_path, monkeypatch):
    monkeypatch.setattr(methods, "PEER_PYTHON", tmp_path / "no python")
    with Recorder(tmp_path, "quick") as recorder:
        compare(recorder, SCENES, [SMALL], ["captured", "pyfibrebundle"], Effort(), images=True)
    tables = report.write(recorder.results).read_text(encoding="utf-8")
    assert "not installed: make peers" in tables
    assert "captured frame" in tables


def test_a_peer_that_breaks_has_its_row_too(tmp_path, monkeypatch):
    monkeypatch.setattr(methods, "PEER_PYTHON", Path(sys.executable))  # which has no such package
    with pytest.raises(PeerError, match="No module named 'pybundle'"):
        METHODS["pyfibrebundle"].run(SMALL, SMALL.make(), Effort())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--methods", "magic"], "unknown method 'magic'; known: captured, gaussian"),
        (["--scenes", "moon"], "unknown case 'moon'; known: liver, kidney"),
        (["--tables", "4", "--burst", "nowhere"], "expected burst.tif in nowhere"),
    ],
)
def test_bad_calls_name_what_there_is(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmarks", *arguments, "--results", str(tmp_path / "new")])
    assert command.main() == 2
    assert words in capsys.readouterr().err


def test_cases_can_be_found_by_name():
    assert [case.name for case in cases.find(["chart"], cases.comparison())] == ["chart"]
    with pytest.raises(SettingsError, match="known: as it is"):
        cases.find(["?"], cases.conditions())


def test_the_same_recipe_gives_the_same_burst():
    one, two = SMALL.make(), Case(name="other", scene="cat", side=80, pitch=4.0, frames=6, seed=3).make()
    np.testing.assert_array_equal(one.burst.frames, two.burst.frames)


def test_fewer_and_shuffled_frames_keep_their_truth():
    whole = SMALL.make()
    few = Case(**{**vars_of(SMALL), "keep": 2}).make()
    np.testing.assert_array_equal(few.burst.frames, whole.burst.frames[:2])
    mixed = Case(**{**vars_of(SMALL), "order": "shuffled"}).make()
    where = [next(t for t in range(6) if np.array_equal(frame, whole.burst.frames[t])) for frame in mixed.burst.frames]
    assert sorted(where) == list(range(6))
    assert where != list(range(6))
    np.testing.assert_array_equal(mixed.homographies, whole.homographies[where])
    single = Case(**{**vars_of(SMALL), "keep": 1}).make()
    np.testing.assert_array_equal(single.burst.frames[0], single.burst.frames[1])


def vars_of(case):
    return {name: getattr(case, name) for name in case.__dataclass_fields__}


def test_the_methods_draw_frame_0_and_the_best_is_ours():
    case = Case(name="twelve frames", scene="cat", side=80, pitch=4.0, frames=12, seed=3)
    simulated = case.make()
    truth = simulated.truth[0]
    quality = {}
    for name in ("captured", "gaussian", "gaussian-fixed", "mean", "unet", "inpainting", "default", "oracle"):
        outcome = METHODS[name].run(case, simulated, Effort(inpainting_steps=150))
        assert outcome.image.shape == truth.shape
        quality[name] = psnr(outcome.image, truth)
    peers = {name: value for name, value in quality.items() if name not in ("default", "oracle")}
    assert quality["captured"] == min(quality.values())
    assert quality["gaussian"] >= quality["gaussian-fixed"]
    assert quality["unet"] > quality["captured"] + 4
    assert quality["inpainting"] > quality["captured"] + 4
    assert quality["default"] > max(peers.values()) + 2
    assert abs(quality["default"] - quality["oracle"]) < 1


def test_the_trained_weights_are_small_enough_to_ship():
    assert methods.unet.WEIGHTS.stat().st_size < 5 * 2**20


def test_time_to_quality_takes_previews_into_account():
    row = {"curve": [(1.0, 18.0), (2.0, 24.0)], "seconds": 9.0, "psnr": 30.0}
    assert report.seconds_to(row, 20) == 2.0
    assert report.seconds_to(row, 29) == 9.0
    assert report.seconds_to(row, 31) is None
    falling = {"curve": [(1.0, 18.0), (2.0, 36.0), (3.0, 29.0)], "seconds": 9.0, "psnr": 34.0}
    assert report.seconds_to(falling, 35) is None
    assert report.seconds_to(falling, 30) == 9.0


@pytest.fixture(scope="module")
def drawn_chart():
    """Bars of a known contrast at the known places: dark 50, glass 150, bars of G7E6 at half the depth."""
    image = np.full(chart.FRAME, 150.0)
    rows, columns = np.indices(chart.FRAME)
    x, y, half = chart.SQUARE
    image[np.hypot(columns - x, rows - y) < 1.5 * half] = 50
    for (group, element, bars), (x, y) in PLACES.items():
        period = period_of(group, element)
        cosine, sine = np.cos(chart.ANGLE), np.sin(chart.ANGLE)
        across = (columns - x) * cosine + (rows - y) * sine
        along = -(columns - x) * sine + (rows - y) * cosine
        if bars == "H":
            across, along = along, across
        inside = (np.abs(along) < 1.25 * period) & (np.abs(across) < 1.3 * period)
        depth = 50 if (group, element) == (7, 6) else 100
        dark = inside & (np.abs(across / period - np.rint(across / period)) < 0.25)
        image[dark] = 150 - depth
    return image


def test_the_chart_is_read_as_it_was_drawn(drawn_chart):
    shown = Shown(drawn_chart, Canvas.over((0, 0, *chart.FRAME[::-1])))
    np.testing.assert_allclose(shown.levels, (50, 150), atol=0.5)
    found = {(row["group"], row["element"], row["bars"]): row for row in shown.elements()}
    assert found[6, 1, "H"]["modulation"] == pytest.approx(1, abs=0.05)
    assert found[7, 5, "V"]["modulation"] == pytest.approx(1, abs=0.15)
    assert found[7, 6, "V"]["modulation"] == pytest.approx(0.5, abs=0.1)
    assert chart.finest(list(found.values())) == "G7E6"


def test_a_chart_without_bars_resolves_nothing(drawn_chart):
    rng = np.random.default_rng(0)
    blank = 150 + rng.normal(0, 5, chart.FRAME)
    blank[588:623, 615:650] = 50
    rows = list(Shown(blank, Canvas.over((0, 0, *chart.FRAME[::-1]))).elements())
    assert chart.finest(rows) == "none"


def test_a_lattice_shows_in_the_ring():
    flat = np.full(chart.FRAME, 150.0)
    flat[588:623, 615:650] = 50
    honeycomb = flat + 10 * np.cos(2 * np.pi * chart.LATTICE * np.arange(chart.FRAME[1]))
    canvas = Canvas.over((0, 0, *chart.FRAME[::-1]))
    plain, dirty = Shown(flat, canvas).ring(), Shown(honeycomb, canvas).ring()
    assert plain < 1e-6
    assert dirty == pytest.approx(10 / np.sqrt(2) / 100, rel=0.1)


def test_the_report_is_valid_where_little_is_there(tmp_path):
    with Recorder(tmp_path, "quick") as recorder:
        pass
    assert "Measured" in report.write(recorder.results).read_text(encoding="utf-8")
    assert json.loads((tmp_path / "about.json").read_text())["mode"] == "quick"


@pytest.fixture
def measured(tmp_path):
    """Return a results folder with two methods of the first table."""
    with Recorder(tmp_path / "results", "quick") as recorder:
        compare(recorder, SCENES, [SMALL], ["captured", "gaussian-fixed"], Effort(), images=True)
    return recorder.results


def test_what_is_published_finds_its_figures(measured, tmp_path, monkeypatch):
    target = tmp_path / "docs" / "results"
    monkeypatch.setattr(sys, "argv", ["publish", str(target), "--results", str(measured.folder)])
    assert publish.main() == 0
    links = re.findall(r"\]\((.+?)\)", (target.parent / "tables.md").read_text(encoding="utf-8"))
    assert "results/figures/scenes.webp" in links
    assert all((target.parent / link).exists() for link in links)


def test_rows_measured_later_are_merged_into_what_is_published(measured, tmp_path, capsys):
    target = tmp_path / "docs" / "results"
    publish.publish(measured.folder, target, [1])
    with Recorder(tmp_path / "later", "quick") as later:
        later.row(SCENES, "small", "gaussian-fixed", lambda: {**measured.rows(SCENES)[2], "psnr": 99.0})
        later.row(CONDITIONS, "small", "captured", lambda: measured.rows(SCENES)[1])
    before = (target / "figures" / "scenes.webp").read_bytes()
    publish.publish(later.results.folder, target, [1])
    merged = Results(target)
    assert [row["method"] for row in merged.rows(SCENES)] == ["truth", "captured", "gaussian-fixed"]
    assert merged.rows(SCENES)[:2] == measured.rows(SCENES)[:2]
    assert merged.rows(SCENES)[2]["psnr"] == 99
    assert merged.rows(CONDITIONS) == []
    assert "99.00" in (target.parent / "tables.md").read_text(encoding="utf-8")
    assert "scenes.webp stays as it was" in capsys.readouterr().out
    assert (target / "figures" / "scenes.webp").read_bytes() == before
    publish.publish(later.results.folder, target, [1, 3], overwrite=True)
    assert [row["method"] for row in merged.rows(SCENES)] == ["gaussian-fixed"]
    assert [row["method"] for row in merged.rows(CONDITIONS)] == ["captured"]


def test_rows_of_two_kinds_of_run_are_not_published_together(measured, tmp_path, monkeypatch, capsys):
    target = tmp_path / "docs" / "results"
    publish.publish(measured.folder, target, [1])
    with Recorder(tmp_path / "full", "full") as full:
        full.row(SCENES, "small", "captured", lambda: measured.rows(SCENES)[1])
    arguments = ["publish", str(target), "--results", str(tmp_path / "full")]
    monkeypatch.setattr(sys, "argv", arguments)
    assert publish.main() == 2
    assert "has rows of a quick run" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", [*arguments, "--overwrite"])
    assert publish.main() == 0
    assert [row["method"] for row in Results(target).rows(SCENES)] == ["captured"]


def test_a_peer_that_is_missing_here_keeps_its_published_row(tmp_path):
    target = tmp_path / "docs" / "results"
    for name, found in (("with", {"psnr": 20.0, "ssim": 0.5}), ("without", {})):
        with Recorder(tmp_path / name, "quick") as recorder:
            for method in ("pyfibrebundle", "pyfibrebundle-sr"):
                is_missing = not found or method == "pyfibrebundle-sr"
                row = {"burst": vars_of(SMALL)} | ({"missing": "not installed"} if is_missing else found)
                recorder.row(CONDITIONS, "as it is", method, lambda row=row: row)
        publish.publish(tmp_path / name, target, [3])
    published = {row["method"]: row for row in Results(target).rows(CONDITIONS)}
    assert published["pyfibrebundle"]["psnr"] == 20
    assert published["pyfibrebundle-sr"]["missing"] == "not installed"


def test_nothing_measured_is_nothing_to_publish(tmp_path):
    with pytest.raises(OutputError, match=r"has no rows of tables \[1, 3\]; measure them"):
        publish.publish(tmp_path / "empty", tmp_path / "docs" / "results", [1, 3])


def test_curves_of_the_published_start_come_with_their_figure(measured, tmp_path):
    target = tmp_path / "docs" / "results"
    publish.publish(measured.folder, target, [1])
    curves = {"one start": [(40, 17.0, 0.2, 3.0), (80, 21.0, 0.3, 1.5), (120, 20.5, 0.3, 1.25)]}
    write_start_curves(tmp_path / "starts", curves)
    publish.publish(tmp_path / "starts", target, [1])
    write_start_curves(tmp_path / "others", {"another start": [(40, 16.0, 0.1, 4.0)]})
    publish.publish(tmp_path / "others", target, [1])
    tables = (target.parent / "tables.md").read_text(encoding="utf-8")
    assert "| one start | 21.0 / 0.30 at step 80 | 20.5 / 0.30 at step 120 | 1.25 px |" in tables
    assert "| another start | 16.0 / 0.10 at step 40 |" in tables
    assert "(results/figures/published_start.webp)" in tables
    assert (target / "figures" / "published_start.webp").exists()
    assert [row["method"] for row in Results(target).rows(SCENES)] == ["truth", "captured", "gaussian-fixed"]


def test_the_identity_as_start_changes_the_motion_alone():
    burst = SMALL.make().burst
    published, still = (published_start.unfitted(burst, 5.0) for _ in range(2))
    published_start.start_at_identity(still)
    assert np.abs(published.renderer.homographies()[1:] - np.eye(3)).max() > 0.1
    np.testing.assert_array_equal(still.renderer.homographies(), np.tile(np.eye(3), (6, 1, 1)))
    scenes = [result.renderer.field.scene.state_dict() for result in (published, still)]
    assert all(np.array_equal(scenes[0][name], scenes[1][name]) for name in scenes[0])
    assert published.losses.size == 0


def test_a_row_whose_peer_was_missing_is_measured_again(tmp_path):
    with Recorder(tmp_path, "quick") as first:
        first.row(SCENES, "a", "unet", lambda: {"missing": "not installed"})
    with Recorder(tmp_path, "quick", resume=True) as again:
        assert again.row(SCENES, "a", "unet", lambda: {"psnr": 20.0})["psnr"] == 20


def test_a_row_of_another_recipe_takes_the_place_of_the_old_one(tmp_path):
    with Recorder(tmp_path, "quick") as first:
        for method in ("paper", "unet"):
            first.row(SCENES, "a", method, lambda: {"psnr": 1.0}, {"paper_iterations": 30})
    with Recorder(tmp_path, "quick", resume=True) as again:
        assert again.row(SCENES, "a", "paper", lambda: {"psnr": 2.0}, {"paper_iterations": 30})["psnr"] == 1
        assert again.row(SCENES, "a", "paper", lambda: {"psnr": 3.0}, {"paper_iterations": 3000})["psnr"] == 3
    assert [(row["method"], row["psnr"]) for row in again.results.rows(SCENES)] == [("paper", 3.0), ("unet", 1.0)]


def test_a_failed_fit_is_reported_and_leaves_the_tables(tmp_path, monkeypatch, capsys):
    arguments = ["--quick", "--tables", "5", "--device", "abacus", "--results", str(tmp_path / "new")]
    monkeypatch.setattr(sys, "argv", ["benchmarks", *arguments])
    assert command.main() == 2
    assert "abacus" in capsys.readouterr().err
    assert (tmp_path / "new" / "tables.md").exists()


UNFAULTY = Case(name="small", side=80, pitch=4.7, frames=6, channels=1)


@pytest.fixture(scope="module")
def recorded_rows(tmp_path_factory):
    """Return the rows of two faulty bursts of one scene, by case and method, and their tables."""
    faulty = [
        replace(UNFAULTY, name="flicker", faults={"flicker": 0.2}),
        replace(UNFAULTY, name="field", faults={"field": 0.8, "overlay": True}),
    ]
    with Recorder(tmp_path_factory.mktemp("recorded"), "quick") as recorder:
        measure_recorded(recorder, faulty, ["captured", "gaussian", "default"], Effort(device="cpu"))
        rows = {(row["case"], row["method"]): row for row in recorder.results.rows(RECORDED)}
        return rows, report.in_markdown(recorder.results)


def test_a_recorded_burst_is_measured_beside_the_same_one_without_its_fault(recorded_rows):
    rows, tables = recorded_rows
    assert {method for _, method in rows} == {"default", "gaussian", "clean"}
    clean = UNFAULTY.make()
    expected = score(METHODS["default"].run(UNFAULTY, clean, Effort(device="cpu")), clean)
    assert rows["flicker", "clean"]["psnr"] == pytest.approx(expected["psnr"], abs=0.01)
    assert rows["flicker", "default"]["psnr"] != pytest.approx(expected["psnr"], abs=0.001)
    assert rows["field", "clean"]["seconds"] == rows["flicker", "clean"]["seconds"]  # one run serves both
    assert rows["field", "clean"]["psnr"] != rows["flicker", "clean"]["psnr"]  # but not all of it is visible
    assert rows["flicker", "default"]["burst"]["faults"] == {"flicker": 0.2}
    assert "### Table 6. As recorded" in tables
    assert "| flicker | " in tables


def test_what_is_not_visible_does_not_count(rng):
    case = Case(name="field", side=64, pitch=4.0, frames=2, faults={"field": 0.7, "overlay": True})
    simulated = case.make()
    image = 0.5 * simulated.truth[0] + 0.1
    image[~simulated.visible] = rng.random((int((~simulated.visible).sum()), 3))
    row = score(methods.Outcome(image=image, seconds=0.0), simulated)
    assert row["psnr"] > 100
    assert row["ssim"] == pytest.approx(1)
    error = np.square((0.5 * simulated.truth[0] - 0.1)[simulated.visible]).mean()
    assert row["psnr_as_given"] == pytest.approx(-10 * np.log10(error), abs=1e-4)
    assert 0 < row["ssim_as_given"] < 0.99


def test_a_recorded_burst_that_a_method_refuses_has_the_reason_in_its_row(tmp_path, monkeypatch):
    def refuse(case, simulated, effort):
        raise BurstError("no cores are seen")

    monkeypatch.setitem(METHODS, "default", replace(METHODS["default"], run=refuse))
    with Recorder(tmp_path, "quick") as recorder:
        measure_recorded(recorder, [replace(SMALL, faults={"flicker": 0.1})], ["default"], Effort())
    assert [row["missing"] for row in recorder.results.rows(RECORDED)] == ["no cores are seen"] * 2


def test_faults_change_nothing_but_the_recording():
    for case in cases.recorded(is_quick=True):
        faulty, clean = case.make(), replace(case, faults={}).make()
        np.testing.assert_array_equal(faulty.truth[0], clean.truth[0])
        np.testing.assert_array_equal(faulty.homographies, clean.homographies)
        assert not np.array_equal(faulty.burst.frames, clean.burst.frames)
    assert len({case.name for case in cases.recorded()}) == len(cases.recorded()) == 62


def test_a_machine_that_is_told_of_twice_stands_once():
    machine = dict.fromkeys(MACHINE, "A")
    old = {**dict.fromkeys(MACHINE, "B"), "date": "2026-01-01", "until": "2026-01-02"}
    now = {**machine, "date": "2026-01-03", "earlier": [old]}
    assert with_earlier(now, now)["earlier"] == [old]
