"""The real window, as a newcomer uses it: File > Open Sample, Plugins > Fiber burst reconstruction, Start."""

import numpy as np
from npe2 import PluginManifest
from qtpy.QtGui import QAction
from qtpy.QtWidgets import QMenu, QPushButton, QScrollArea
from skimage.io import imread

from napari_fiberburst.plugin.dock import FiberBurstWidget


def trigger(window: QMenu, *path: str) -> None:
    """Choose an entry of a menu as a user does: by its words."""
    menu = window
    for words in path:
        menu.aboutToShow.emit()
        action: QAction = next(action for action in menu.actions() if action.text().replace("&", "").startswith(words))
        menu = action.menu()
    action.trigger()


def test_a_newcomer_sees_it_resolve(make_napari_viewer, qtbot, npe2pm, tmp_path):
    npe2pm.register(PluginManifest.from_distribution("napari-fiberburst"))
    viewer = make_napari_viewer(show=True)
    trigger(viewer.window.file_menu, "Open Sample", "Fiberburst", "Histology, one value a core")
    trigger(viewer.window.plugins_menu, "Fiber burst reconstruction")
    (dock,) = viewer.window.dock_widgets.values()
    before = viewer.window.screenshot(canvas_only=True, flash=False)
    with qtbot.waitSignal(dock.picture.display.complete, timeout=120_000):
        dock.picture.start_button.click()
    qtbot.wait(200)
    after = viewer.window.screenshot(canvas_only=True, flash=False)
    assert dock.picture.runs.run.result.ending == "finished"
    # All of the way from the burst to what came of it is in sight.
    viewer.window.resize(1280, 800)
    seen = dock.findChild(QScrollArea)
    qtbot.waitUntil(lambda: seen.verticalScrollBar().maximum() == 0)
    qtbot.waitUntil(lambda: seen.widget().width() <= seen.viewport().width())
    # The honeycomb's dark gaps are gone from what is on the screen.
    assert dark(after) < 0.5 * dark(before)
    for theme in ("dark", "light"):
        viewer.theme = theme
        for width, height in ((1280, 800), (1920, 1080)):
            viewer.window.resize(width, height)
            viewer.reset_view()
            qtbot.wait(300)
            path = tmp_path / f"plugin_{theme}_{width}x{height}.png"
            viewer.window.screenshot(str(path), canvas_only=False, flash=False)
            assert imread(path).shape[:2] == (height, width)


def test_the_dock_is_as_wide_as_what_is_in_it_in_a_small_window(make_napari_viewer, qtbot):
    viewer = make_napari_viewer(show=True)
    viewer.window.resize(800, 600)
    dock = FiberBurstWidget(viewer)
    viewer.window.add_dock_widget(dock, name="fiber burst")
    viewer.add_image(np.zeros((5, 31, 37), np.uint8))
    viewer.window.resize(800, 600)
    content, seen = dock.findChild(QScrollArea).widget(), dock.findChild(QScrollArea).viewport()
    qtbot.wait(300)
    qtbot.waitUntil(lambda: content.minimumSizeHint().width() <= seen.width())
    qtbot.waitUntil(lambda: content.width() <= seen.width())
    for button in dock.findChildren(QPushButton):
        assert button.isHidden() or button.width() >= button.minimumSizeHint().width()


def dark(image: np.ndarray) -> float:
    """Return how much of an image is nearly black."""
    return float((image[..., :3].max(axis=-1) < 40).mean())
