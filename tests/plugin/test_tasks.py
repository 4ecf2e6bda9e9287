"""The row of tasks: each is one class in one list; the bundle is measured, looked at and kept in its own."""

import numpy as np
import pytest
from napari.layers import Image
from qtpy.QtWidgets import QFileDialog

from napari_fiberburst import Bundle
from napari_fiberburst.plugin import dock as dock_module
from napari_fiberburst.plugin.tasks import TASKS
from napari_fiberburst.plugin.tasks.bundle import BundleTask
from napari_fiberburst.plugin.tasks.task import Task

MILLISECONDS = 60_000


@pytest.fixture
def bundle_task(open_dock, burst_layer):
    """Return viewer, dock and the task that measures bundles, which is shown."""
    viewer, dock = open_dock(burst_layer)
    dock.choose_task(BundleTask)
    return viewer, dock, next(task for task in dock.tasks if isinstance(task, BundleTask))


def calibrate(task, qtbot):
    task.start_button.click()
    assert not task.start_button.isEnabled()
    qtbot.waitUntil(lambda: not task.words.text().startswith("Measuring"), timeout=MILLISECONDS)


def test_one_task_is_shown_at_a_time_over_the_same_burst(open_dock, burst_layer):
    _, dock = open_dock(burst_layer)
    assert [dock.task_bar.tabText(number) for number in range(dock.task_bar.count())] == [
        "Picture",
        "Video",
        "Mosaic",
        "Bundle",
        "Live",
    ]
    for number, shown in enumerate(dock.tasks):
        dock.task_bar.setCurrentIndex(number)
        assert [task.isHidden() for task in dock.tasks] == [task is not shown for task in dock.tasks]
        assert shown.input is dock.input


def test_a_further_class_in_the_list_is_offered(open_dock, burst_layer, monkeypatch):
    class Another(Task):
        title, tip, is_empty = "Another", "Does something else.", True

    monkeypatch.setattr(dock_module, "TASKS", (*TASKS, Another))
    _, dock = open_dock(burst_layer)
    dock.choose_task(Another)
    assert dock.task_bar.tabText(dock.task_bar.currentIndex()) == "Another"
    assert not dock.tasks[-1].isHidden()
    assert dock.picture.isHidden()


def test_a_bundle_is_measured_in_the_burst_shown_and_chosen(bundle_task, qtbot, simulated):
    viewer, dock, task = bundle_task
    calibrate(task, qtbot)
    bundle = dock.input.bundle_source().bundle
    assert viewer.layers["bundle of burst"].data is bundle.transmission
    assert len(viewer.layers["bundle of burst cores"].data) == len(bundle.centres) + len(bundle.dead)
    assert bundle.pitch == pytest.approx(4.0, abs=0.1)
    expected = Bundle.from_burst(simulated.burst)
    np.testing.assert_allclose(bundle.centres, expected.centres, atol=1e-3)
    for told in (str(len(bundle.centres)), f"{bundle.pitch:.2f} pixels"):
        assert told in task.numbers.text()


def test_a_bundle_is_measured_in_an_image_of_it_in_even_light(bundle_task, qtbot, simulated):
    viewer, dock, task = bundle_task
    flat = np.rint(255 * simulated.transmission / simulated.transmission.max()).astype(np.uint8)
    dock.input.bundle.value = viewer.add_layer(Image(flat, name="flat"))
    assert "flat" in task.words.text()
    calibrate(task, qtbot)
    bundle = dock.input.bundle_source().bundle
    assert bundle.gains_known
    np.testing.assert_allclose(bundle.centres, Bundle.from_image(flat).centres, atol=1e-3)


def test_a_bundle_is_kept_in_a_file_and_serves_the_next_burst(bundle_task, qtbot, tmp_path, monkeypatch, run_through):
    _, dock, task = bundle_task
    assert not task.keep_button.isEnabled()
    calibrate(task, qtbot)
    assert not task.start_button.isEnabled()
    path = tmp_path / "probe.bundle"
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(path), ""))
    task.keep_button.click()
    kept, chosen = Bundle.load(path), dock.input.bundle_source().bundle
    np.testing.assert_array_equal(kept.transmission, chosen.transmission)
    run = run_through(dock)
    assert run.bundle.name == "bundle of burst"


def test_what_shows_no_bundle_is_said(bundle_task, qtbot):
    viewer, dock, task = bundle_task
    plain = np.random.default_rng(0).normal(100, 3, (6, 63, 75)).clip(0, 255).astype(np.uint8)
    dock.input.burst.value = viewer.add_layer(Image(plain, name="plain"))
    calibrate(task, qtbot)
    assert "no bundle is seen" in task.words.text()
    assert dock.input.bundle.value is None
    assert task.start_button.isEnabled()
