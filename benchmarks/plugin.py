"""How the plugin keeps up with the script: first image, speed, and how long the window is held up.

Runs in a window that is drawn, under Xvfb on a machine without a display: `xvfb-run python benchmarks/plugin.py`.
"""

import gc
import os
import time
from collections.abc import Callable
from typing import Any

import napari
import psutil
from qtpy.QtCore import QEventLoop, QTimer

from napari_fiberburst import reconstruct
from napari_fiberburst.plugin.contributions import make_sample
from napari_fiberburst.plugin.dock import FiberBurstWidget

ROUNDS = 3
# The published method runs for half a minute, which shows the speed in the long run; the default is done in seconds.
FITS: dict[str, dict[str, Any]] = {"auto": {}, "paper, 100 steps": {"preset": "paper", "iterations": 100}}
CYCLES = 100
MEBIBYTE = 2**20


def wait_until(is_done: Callable[[], bool], seconds: float = 600) -> None:
    """Let the window live until something is the case."""
    loop, timer, began = QEventLoop(), QTimer(), time.perf_counter()
    timer.timeout.connect(lambda: loop.quit() if is_done() or time.perf_counter() - began > seconds else None)
    timer.start(50)
    loop.exec()


class Heartbeat:
    """Notes how long the event loop was away between two turns, longest first."""

    def __init__(self) -> None:
        self.gaps: list[float] = []
        self._timer = QTimer()
        self._timer.timeout.connect(self._beat)
        self._last = time.perf_counter()
        self._timer.start(20)

    def _beat(self) -> None:
        now = time.perf_counter()
        self.gaps.append(now - self._last)
        self._last = now

    def stop(self) -> list[float]:
        """Return the gaps in milliseconds."""
        self._timer.stop()
        return sorted((1e3 * gap for gap in self.gaps), reverse=True)


def in_plugin(viewer: Any, dock: FiberBurstWidget) -> dict[str, Any]:
    """Run what the form says; return what a user notices."""
    began = time.perf_counter()
    first: list[float] = []
    rates: list[float] = []
    complete: list[Any] = []
    seen = viewer.layers.events.inserted.connect(lambda _: first.append(time.perf_counter() - began))
    reported = dock.picture.runner.reported.connect(lambda report: rates.append(report.rate))
    ended = dock.picture.display.complete.connect(complete.append)
    beat = Heartbeat()
    dock.picture.start()
    wait_until(lambda: dock.picture.runner.state == "ready")
    gaps = beat.stop()
    wait_until(lambda: bool(complete))
    viewer.layers.events.inserted.disconnect(seen)
    dock.picture.runner.reported.disconnect(reported)
    dock.picture.display.complete.disconnect(ended)
    return {"first": first[0], "rate": rates[-1], "gaps": gaps}


def in_script(frames: Any, choices: dict[str, Any], preview_every: float) -> float:
    """Return the steps per second of the same call without a window's work."""
    rates: list[float] = []
    reconstruct(frames, **choices, preview_every=preview_every, on_progress=lambda report: rates.append(report.rate))
    return rates[-1]


def measure_speed() -> None:
    """Print plugin and script side by side, the first round cold; in a window that is drawn."""
    for name, choices in FITS.items():
        viewer, dock, frames = open_window(is_drawn=os.environ.get("QT_QPA_PLATFORM") != "offscreen")
        dock.picture.form.set_choices(choices)
        for number in range(ROUNDS):
            found = in_plugin(viewer, dock)
            script = in_script(frames, choices, 0.25)
            longest = ", ".join(f"{gap:.0f}" for gap in found["gaps"][:3])
            late = sum(gap > 100 for gap in found["gaps"])
            print(
                f"{name:18} {'cold' if number == 0 else 'warm'}: first image {found['first']:.1f} s; "
                f"{found['rate']:.2f} it/s, script {script:.2f}, ratio {found['rate'] / script:.2f}; window away for "
                f"{longest} ms at most, over 100 ms {late} times"
            )
        viewer.close()


def measure_leaks() -> None:
    """Print what is left after runs that were removed, and after many starts and stops; nothing is drawn here."""
    viewer, dock, _ = open_window(is_drawn=False)
    process = psutil.Process()

    def resident() -> float:
        gc.collect()
        return process.memory_info().rss / MEBIBYTE

    in_plugin(viewer, dock)  # loads what stays loaded
    remove_runs(dock)
    before, threads = resident(), process.num_threads()
    for _ in range(ROUNDS):
        in_plugin(viewer, dock)
        remove_runs(dock)
    print(f"{ROUNDS} runs, each removed: memory {before:.0f} -> {resident():.0f} MiB")
    for _ in range(CYCLES):
        dock.picture.start()
        dock.picture.runner.stop()
        wait_until(lambda: dock.picture.runner.state == "ready")
        remove_runs(dock)
    after = resident()
    print(
        f"{CYCLES} starts and stops: memory {before:.0f} -> {after:.0f} MiB ({after / before - 1:+.1%}), threads "
        f"{threads} -> {process.num_threads()}, progress bars left {len(napari.utils.progress._all_instances)}"
    )
    viewer.close()


def remove_runs(dock: FiberBurstWidget) -> None:
    """Forget all runs and their layers."""
    for run in dock.picture.runs.runs:
        dock.picture.runs.remove(run)


def open_window(*, is_drawn: bool) -> tuple[Any, FiberBurstWidget, Any]:
    """Return a viewer with a sample and the dock, and the sample's frames."""
    ((frames, look, _),) = make_sample("histology", "mask")
    viewer = napari.Viewer(show=is_drawn)
    viewer.window.resize(1280, 800)
    viewer.add_image(frames, **look)
    dock = FiberBurstWidget(viewer)
    viewer.window.add_dock_widget(dock, name="fiber burst")
    dock.picture.form.set_choices({})
    return viewer, dock, frames


if __name__ == "__main__":
    measure_speed()
    measure_leaks()
