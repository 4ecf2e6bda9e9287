"""The report of a run, from its card."""

from dataclasses import replace
from html import escape, unescape
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from napari.layers import Image
from qtpy.QtWidgets import QFileDialog

from napari_fiberburst import report as report_module

MILLISECONDS = 60_000
QUICK = {
    "preset": "paper",
    "encoding": "fourier",
    "iterations": 2,
    "scene_width": 16,
    "scene_layers": 1,
    "features": 16,
    "batch": 64,
}


@pytest.fixture
def answer(monkeypatch):
    """Return a function that says what is answered when a place for a file is asked for."""

    def answered(path):
        monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(path), ""))

    return answered


@pytest.fixture
def ran(open_dock, run_through, grey_frames):
    """Return a dock with a quick run of a layer that is called "lung & co", and the run."""
    _, dock = open_dock(Image(grey_frames, scale=(1, 0.5, 0.5), units=("s", "um", "um"), name="lung & co"))
    dock.picture.form.set_choices(QUICK)
    return dock, run_through(dock)


def save(dock, qtbot):
    """Press the button, wait for the end, and return what the dock says then."""
    box = dock.picture.display.card.report
    box.button.click()
    qtbot.waitUntil(lambda: box.button.isEnabled(), timeout=MILLISECONDS)
    return box.words.text()


def test_a_place_is_suggested_beside_the_burst(ran, monkeypatch, tmp_path):
    dock, run = ran
    asked = []
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *words: asked.append(words[2]) or ("", ""))
    box = dock.picture.display.card.report
    box.button.click()
    run.source = replace(run.source, path=str(tmp_path / "lung.tif"))
    box.button.click()
    assert asked == [f"{run.name} report.html", str(tmp_path / f"{run.name} report.html")]


def test_the_report_of_the_run_that_is_shown_is_written_where_it_is_wanted(ran, run_through, qtbot, answer, tmp_path):
    dock, first = ran
    dock.picture.form.set_choices({**QUICK, "iterations": 3})
    run_through(dock)
    first.turned_live.append((1.25, "learning_rate", 0.5))
    dock.picture.runs.select(first)
    path = tmp_path / "lung report.html"
    answer(path)
    words = save(dock, qtbot)
    assert words.startswith("The report of run 1 is in ")
    assert f'href="{path.as_uri()}"' in words
    assert f">{path}</a>" in words
    page = path.read_text(encoding="utf-8")
    assert "<h1>lung &amp; co</h1>" in page
    assert escape(first.python.strip()) in page
    assert "iterations=2" in page
    assert "iterations=3" not in page
    assert "# learning_rate=0.5 from 1.2 s on" in page
    assert "µm" in page


def test_the_call_of_a_report_repeats_the_run(ran, qtbot, answer, tmp_path, grey_frames):
    dock, run = ran
    answer(tmp_path / "report.html")
    save(dock, qtbot)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    call = unescape(page.split("<pre>")[1].split("</pre>")[0])
    scope = {"viewer": dock.picture.display.card._viewer}
    exec(call.replace('result.save("image.ome.tif")', ""), scope)
    np.testing.assert_allclose(scope["result"].image, run.result.image, rtol=1e-3)


def test_the_window_does_not_wait_for_a_report(ran, qtbot, answer, monkeypatch, tmp_path):
    dock, _ = ran
    written = Event()
    monkeypatch.setattr(report_module, "write_report", lambda _, __, path, **___: written.wait(60) and Path(path))
    answer(tmp_path / "report.html")
    box = dock.picture.display.card.report
    box.button.click()
    assert box.words.text() == "Writing the report."
    assert not box.button.isEnabled()
    dock.picture.display.card.refresh()
    assert not box.button.isEnabled()
    written.set()
    qtbot.waitUntil(lambda: box.button.isEnabled(), timeout=MILLISECONDS)
    assert "report.html" in box.words.text()


def test_the_dock_says_why_there_is_no_report(ran, qtbot, answer, monkeypatch, tmp_path):
    dock, _ = ran
    answer(tmp_path / "nowhere" / "report.html")
    assert save(dock, qtbot).startswith("The report of run 1 was not written: ")
    assert "nowhere" in dock.picture.display.card.report.words.text()
    answer(tmp_path / "report.txt")
    assert "a report is written to a file ending in .html" in save(dock, qtbot)
    assert not list(tmp_path.glob("report*"))

    def fail(*_, **__):
        raise OSError("the disk <1> went away")

    monkeypatch.setattr(report_module, "write_report", fail)
    answer(tmp_path / "report.html")
    assert "OSError: the disk &lt;1&gt; went away" in save(dock, qtbot)


def test_there_is_a_report_once_a_run_has_ended_and_none_where_no_place_is_given(
    open_dock, run_through, qtbot, answer, burst_layer, tmp_path
):
    _, dock = open_dock(burst_layer)
    box = dock.picture.display.card.report
    assert box.isHidden()
    dock.picture.form.set_choices({**QUICK, "iterations": 100_000})
    with qtbot.waitSignal(dock.picture.runner.previewed, timeout=MILLISECONDS):
        dock.picture.start()
    assert box.isHidden()
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        dock.picture.stop_button.click()
    assert not box.isHidden()
    answer("")
    assert save(dock, qtbot) == ""
    # What is said of one run's report is gone where another run is shown.
    answer(tmp_path / "report.html")
    assert save(dock, qtbot) != ""
    dock.picture.form.set_choices(QUICK)
    run_through(dock)
    assert box.words.isHidden()


def test_a_figure_of_the_run_that_is_shown_is_written_where_it_is_wanted(ran, qtbot, answer, tmp_path):
    dock, _ = ran
    box = dock.picture.display.card.report
    for name, begins in (("lung.svg", b"<svg"), ("lung.png", b"\x89PNG")):
        answer(tmp_path / name)
        box.figure_button.click()
        assert box.words.text() == "Writing the figure."
        assert not box.button.isEnabled()
        qtbot.waitUntil(lambda: box.figure_button.isEnabled(), timeout=MILLISECONDS)
        assert box.words.text().startswith("The figure of run 1 is in ")
        assert (tmp_path / name).as_uri() in box.words.text()
        assert (tmp_path / name).read_bytes().startswith(begins)
    assert "µm" in (tmp_path / "lung.svg").read_text(encoding="utf-8")
    answer(tmp_path / "lung.pdf")
    box.figure_button.click()
    qtbot.waitUntil(lambda: box.figure_button.isEnabled(), timeout=MILLISECONDS)
    assert "a figure is written to a file ending in .png or .svg" in box.words.text()
