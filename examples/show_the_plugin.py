"""Show the dock in every state it can be in, in both themes: pictures for the documentation.

    python examples/show_the_plugin.py docs/plugin

Without a display, put `xvfb-run -s "-screen 0 1280x800x24"` in front.
"""

import contextlib
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import napari
import numpy as np
from PIL import Image
from qtpy.QtCore import QEventLoop, QTimer

from napari_fiberburst.plugin.contributions import make_sample
from napari_fiberburst.plugin.recordings import recording_layer
from napari_fiberburst.plugin.tasks.bundle import BundleTask
from napari_fiberburst.plugin.tasks.mosaic import MosaicTask
from napari_fiberburst.plugin.tasks.video import VideoTask
from napari_fiberburst.simulation import simulate_recording

WIDTH, HEIGHT, QUALITY = 1280, 800, 85
# Frames that move as long as they are exposed: detail along the motion is lost.
SMEARED = {"smear": 1.0}
# Of a hand that wanders; and for how long a camera is looked at.
RECORDING: dict[str, Any] = {
    "path": "handheld",
    "frames": 120,
    "shape": (200, 200),
    "turn": 2.0,
    "pitch": 4.0,
    "seed": 4,
}
SECONDS_LIVE = 8


def wait(until: Callable[[], bool], seconds: float = 120) -> None:
    """Let the window live until something is so."""
    loop, ticks = QEventLoop(), QTimer()
    ticks.timeout.connect(lambda: loop.quit() if until() else None)
    ticks.start(50)
    QTimer.singleShot(round(1000 * seconds), loop.quit)
    loop.exec()


def rest(seconds: float = 0.8) -> None:
    """Let the window come to rest."""
    wait(lambda: False, seconds)


class States:
    """One window, taken from state to state.

    Parameters
    ----------
    folder : Path
        Where the pictures go.
    theme : str
        "dark" or "light".
    """

    def __init__(self, folder: Path, theme: str) -> None:
        self.folder, self.theme = folder, theme
        self.viewer = napari.Viewer()
        self.viewer.theme = theme
        self.viewer.window.resize(WIDTH, HEIGHT)
        _, self.dock = self.viewer.window.add_plugin_dock_widget("napari-fiberburst", "Fiber burst reconstruction")

    def show_live(self) -> None:
        """Go from the empty dock to the live view."""
        self.dock.empty.live_button.click()
        live = self.dock.live
        live.mosaic.setChecked(True)
        live.start()
        wait(lambda: live.words.text() == "Good")
        rest(SECONDS_LIVE)
        self.take("live")
        live.stop()
        wait(lambda: live.job is None)
        self.viewer.close()

    def show_recording(self) -> None:
        """Make a mosaic of a recording, with the task *Video* before it."""
        recording = simulate_recording(**RECORDING)
        frames, look, _ = recording_layer(recording.source, "recording")
        self.viewer.add_image(frames, **look)
        self.dock.choose_task(VideoTask)
        self.dock.task.output.edit.setText("recording-video.ome.zarr")
        self.take("video")
        self.dock.choose_task(MosaicTask)
        task = self.dock.task
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            task.output.edit.setText("recording-mosaic.ome.zarr")
            task.start_button.click()
            wait(lambda: bool(task.words.text()) or task.job is None)
            self.viewer.reset_view()
            self.take("mosaic")
            self.viewer.close()

    def show_picture(self) -> None:
        """Go through all states of the tasks *Picture* and *Bundle*."""
        picture = self.dock.picture
        self.take("empty")
        self.open()
        self.take("ready")
        # Networks learn for as long as somebody may want to look at them; the default is done too soon.
        picture.form.set_choices({"preset": "paper"})
        self.run_until(lambda: picture.display.bar.value() > 0.02 * picture.display.bar.maximum())
        self.take("running")
        picture.stop_button.click()
        wait(lambda: picture.runner.state == "ready")
        picture.runs.remove(*picture.runs.runs)
        picture.form.set_choices({})
        self.run_until(lambda: picture.runner.state == "ready")
        self.take("good")
        picture.runs.compare.way.setCurrentText("curtain")
        picture.runs.compare.button.click()
        self.take("compared")
        picture.runs.compare.button.click()
        self.dock.choose_task(BundleTask)
        self.dock.task.start_button.click()
        wait(lambda: self.dock.input.bundle.value is not None)
        self.take("bundle")
        self.dock.task_bar.setCurrentIndex(0)
        self.viewer.layers.clear()
        self.open(**SMEARED)
        self.run_until(lambda: picture.runner.state == "ready")
        self.take("doubtful")
        self.dock.input.bundle.value = self.viewer.add_image(
            np.random.default_rng(0).normal(100, 5, (256, 256)), name="image of the bundle", visible=False
        )
        self.run_until(lambda: picture.runner.state == "ready")
        self.take("failed")
        self.viewer.close()

    def open(self, **faults: Any) -> None:
        """Open a burst, and wait until it has been looked at."""
        for data, look, _ in make_sample("histology", "core", **faults):
            self.viewer.add_image(data, **look)
        wait(lambda: "moves by" in self.dock.glance.words.text())
        self.viewer.reset_view()

    def run_until(self, is_so: Callable[[], bool]) -> None:
        """Press Start and wait."""
        self.dock.picture.start_button.click()
        wait(is_so)

    def take(self, state: str) -> None:
        """Write what the window shows."""
        rest()
        shown = Image.fromarray(self.viewer.window.screenshot(canvas_only=False, flash=False)).convert("RGB")
        path = self.folder / f"{state}_{self.theme}.webp"
        shown.save(path, quality=QUALITY)
        print(f"wrote {path}")


def main(folder: Path) -> None:
    """Write a picture of each state in each theme."""
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    for theme in ("dark", "light"):
        States(folder, theme).show_picture()
        States(folder, theme).show_recording()
        States(folder, theme).show_live()


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "plugin"))
