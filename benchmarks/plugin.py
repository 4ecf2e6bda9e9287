"""How the plugin keeps up with the script: first image, speed, how long the window is held up, and what is left behind.

Runs in a window that is drawn, under Xvfb on a machine without a display: `xvfb-run python benchmarks/plugin.py`. All
of it, or the parts that are named behind: speed, switches, runs, leaks, live.
"""

import gc
import os
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from types import FunctionType, ModuleType
from typing import Any

import napari
import numpy as np
import psutil
import torch
from napari.components import ViewerModel
from napari.layers import Layer
from qtpy.QtCore import QEventLoop, QObject, QTimer
from qtpy.QtWidgets import QApplication

from napari_fiberburst import reconstruct
from napari_fiberburst.plugin.contributions import make_sample
from napari_fiberburst.plugin.dock import FiberBurstWidget
from napari_fiberburst.plugin.tasks.live import LiveTask
from napari_fiberburst.simulation import simulate

ROUNDS = 3
# The published method runs for half a minute, which shows the speed in the long run; the default is done in seconds.
FITS: dict[str, dict[str, Any]] = {"auto": {}, "paper, 100 steps": {"preset": "paper", "iterations": 100}}
CYCLES = 100
# Runs that are all kept, of small bursts, of which some are run before it counts: torch and napari keep what they load.
KEPT, SETTLING, SMALL = 50, 10, (72, 96)
LIVE_SECONDS = 10
# What a large result's card does takes as long whatever the run came to.
LARGE, SHORT = (1024, 1024), {"motion": "translation", "iterations": 1}
MEBIBYTE = 2**20
# What runs refer to without keeping it.
_ELSEWHERE = (type, ModuleType, FunctionType, QObject, ViewerModel, Layer)


def wait_until(is_done: Callable[[], bool], seconds: float = 600) -> None:
    """Let the window live until something is the case."""
    loop, timer, began = QEventLoop(), QTimer(), time.perf_counter()
    timer.timeout.connect(lambda: loop.quit() if is_done() or time.perf_counter() - began > seconds else None)
    timer.start(50)
    loop.exec()


class Heartbeat:
    """Notes when the event loop was away between two turns."""

    def __init__(self) -> None:
        self._turns: list[float] = [time.perf_counter()]
        self._timer = QTimer()
        self._timer.timeout.connect(lambda: self._turns.append(time.perf_counter()))
        self._timer.start(20)

    def stop(self, layers_at: list[float]) -> tuple[list[float], list[float]]:
        """Return how long it was away, in milliseconds, longest first: while layers were made, and else."""
        self._timer.stop()
        gaps: tuple[list[float], list[float]] = ([], [])
        for before, after in pairwise(self._turns):
            is_making = any(before <= made <= after for made in layers_at)
            gaps[not is_making].append(1e3 * (after - before))
        return sorted(gaps[0], reverse=True), sorted(gaps[1], reverse=True)


def in_plugin(viewer: Any, dock: FiberBurstWidget) -> dict[str, Any]:
    """Run what the form says; return what a user notices."""
    began = time.perf_counter()
    made: list[float] = []
    previewed = [began]
    rates: list[float] = []
    complete: list[Any] = []
    seen = viewer.layers.events.inserted.connect(lambda _: made.append(time.perf_counter()))
    runner = dock.picture.runner
    reported = runner.reported.connect(lambda report: rates.append(report.rate))
    shown = runner.previewed.connect(lambda _: previewed.append(time.perf_counter()))
    ended = dock.picture.display.complete.connect(complete.append)
    beat = Heartbeat()
    dock.picture.start()
    wait_until(lambda: runner.state == "ready")
    wait_until(lambda: bool(complete))
    previewed.append(time.perf_counter())
    making, others = beat.stop(made)
    viewer.layers.events.inserted.disconnect(seen)
    runner.reported.disconnect(reported)
    runner.previewed.disconnect(shown)
    dock.picture.display.complete.disconnect(ended)
    return {
        "first": made[0] - began,
        "rate": rates[-1],
        "making": making,
        "others": others,
        "previews": max(after - before for before, after in pairwise(previewed)),
    }


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
            longest = ", ".join(f"{gap:.0f}" for gap in found["others"][:3])
            late = sum(gap > 100 for gap in found["others"])
            print(
                f"{name:18} {'cold' if number == 0 else 'warm'}: first image {found['first']:.1f} s; no image for "
                f"{found['previews']:.1f} s at most; {found['rate']:.2f} it/s, script {script:.2f}, ratio "
                f"{found['rate'] / script:.2f}; window away for {max(found['making'], default=0):.0f} ms when layers "
                f"are made, else {longest} ms at most, over 100 ms {late} times",
                flush=True,
            )
        viewer.close()


def measure_switches() -> None:
    """Print how long the window takes to show, and to take away, what each switch on the card of a large run is for."""
    frames = simulate("histology", shape=LARGE, frames=20, physics="core").arrays()["frames"]
    viewer = napari.Viewer(show=os.environ.get("QT_QPA_PLATFORM") != "offscreen")
    viewer.window.resize(1280, 800)
    viewer.add_image(frames, rgb=True, axis_labels=("t", "y", "x"), name="burst")
    dock = FiberBurstWidget(viewer)
    viewer.window.add_dock_widget(dock, name="fiber burst")
    dock.picture.form.set_choices(SHORT)
    in_plugin(viewer, dock)
    wait_until(lambda: False, 3)
    for kind, switch in dock.picture.display.card.switches.items():
        if not switch.isHidden():
            on, off = (_seconds_of_click(switch) for _ in range(2))
            print(f"switch {kind:16}: on {1e3 * on:.0f} ms, off {1e3 * off:.0f} ms", flush=True)
    viewer.close()


def _seconds_of_click(switch: Any) -> float:
    """Return how long it takes until a switch has been pressed and the window drawn."""
    began = time.perf_counter()
    switch.click()
    QApplication.processEvents()
    took = time.perf_counter() - began
    wait_until(lambda: False, 1)
    return took


def measure_runs() -> None:
    """Print what many runs that are kept leave behind: layers, and memory beside what the runs and napari hold."""
    viewer, dock, _ = open_window(is_drawn=os.environ.get("QT_QPA_PLATFORM") != "offscreen", shape=SMALL)
    for _ in range(SETTLING):
        in_plugin(viewer, dock)
    layers, before, kept_before = len(viewer.layers), _resident(), _held(dock)
    for _ in range(KEPT):
        in_plugin(viewer, dock)
    after, kept = _resident(), _held(dock)
    print(
        f"{KEPT} runs of {SMALL[0]} x {SMALL[1]}, all kept: {(len(viewer.layers) - layers) / KEPT:.1f} layers and "
        f"{(after - before) / KEPT:.2f} MiB a run ({before:.0f} -> {after:.0f} MiB), of which Runs holds "
        f"{(kept - kept_before) / KEPT:.2f}",
        flush=True,
    )
    bare = _resident()
    for _ in range(SETTLING):
        viewer.add_image(np.zeros((*SMALL, 3), np.float32), rgb=True)
        wait_until(lambda: False, 0.2)
    print(
        f"napari takes {(_resident() - bare) / SETTLING:.2f} MiB for a layer of that size that nobody runs", flush=True
    )
    viewer.close()


def _held(dock: FiberBurstWidget) -> float:
    """Return the MiB of all arrays and tensors that the runs that are kept lead to; shared ones count once."""
    found: dict[int, int] = {}
    seen: set[int] = set()
    todo: list[Any] = list(dock.picture.runs.runs)
    while todo:
        one = todo.pop()
        if id(one) in seen or isinstance(one, _ELSEWHERE):
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray) and one.base is None:
            found[one.ctypes.data] = one.nbytes
        elif isinstance(one, torch.Tensor):
            found[one.untyped_storage().data_ptr()] = one.untyped_storage().nbytes()
        todo.extend(gc.get_referents(one))
    return sum(found.values()) / MEBIBYTE


def _resident() -> float:
    gc.collect()
    return psutil.Process().memory_info().rss / MEBIBYTE


def measure_live() -> None:
    """Watch the simulated camera for ten seconds: pictures made and shown, their lag, how long the window is away."""
    viewer, dock, _ = open_window(is_drawn=True)
    dock.choose_task(LiveTask)
    dock.live.start()
    wait_until(lambda: dock.live.words.text() == "Good", 120)
    pulse, began, job, layers = Heartbeat(), time.perf_counter(), dock.live.job, dock.live._layers
    assert job is not None
    assert layers is not None
    shown, rates, lags = layers.shown, [], []
    while (seconds := time.perf_counter() - began) < LIVE_SECONDS:
        wait_until(lambda: False, 0.5)
        rates.append(dock.live.rate)
        lags.append(1e3 * dock.live.lag)
    _, gaps = pulse.stop([])
    dock.live.stop()
    wait_until(lambda: dock.live.job is None)
    shown_rate = (layers.shown - shown) / seconds
    print(
        f"live, 30 frames of 256 x 256 a second: {sum(rates) / len(rates):.0f} pictures made and {shown_rate:.0f} "
        f"shown a second, lag {sorted(lags)[len(lags) // 2]:.0f} ms in the median; window away {gaps[0]:.0f} ms at "
        f"most, {gaps[len(gaps) // 100]:.0f} in the 99th percentile"
    )
    viewer.close()


def measure_leaks() -> None:
    """Print what is left after runs that were removed, and after many starts and stops; nothing is drawn here."""
    viewer, dock, _ = open_window(is_drawn=False)
    process = psutil.Process()
    in_plugin(viewer, dock)  # loads what stays loaded
    remove_runs(dock)
    before, threads = _resident(), process.num_threads()
    for _ in range(ROUNDS):
        in_plugin(viewer, dock)
        remove_runs(dock)
    print(f"{ROUNDS} runs, each removed: memory {before:.0f} -> {_resident():.0f} MiB")
    for _ in range(CYCLES):
        dock.picture.start()
        dock.picture.runner.stop()
        wait_until(lambda: dock.picture.runner.state == "ready")
        remove_runs(dock)
    after = _resident()
    print(
        f"{CYCLES} starts and stops: memory {before:.0f} -> {after:.0f} MiB ({after / before - 1:+.1%}), threads "
        f"{threads} -> {process.num_threads()}, progress bars left {len(napari.utils.progress._all_instances)}"
    )
    viewer.close()


def remove_runs(dock: FiberBurstWidget) -> None:
    """Forget all runs and their layers."""
    for run in dock.picture.runs.runs:
        dock.picture.runs.remove(run)


def open_window(*, is_drawn: bool, shape: tuple[int, int] | None = None) -> tuple[Any, FiberBurstWidget, Any]:
    """Return a viewer with a sample, or the corner of it that has this shape, and the dock; and the frames."""
    ((frames, look, _),) = make_sample("histology", "mask")
    if shape is not None:
        frames, look = frames[:, : shape[0], : shape[1]], {**look, "metadata": {}}
    viewer = napari.Viewer(show=is_drawn)
    viewer.window.resize(1280, 800)
    viewer.add_image(frames, **look)
    dock = FiberBurstWidget(viewer)
    viewer.window.add_dock_widget(dock, name="fiber burst")
    dock.picture.form.set_choices({})
    return viewer, dock, frames


PARTS = {
    "speed": measure_speed,
    "switches": measure_switches,
    "runs": measure_runs,
    "leaks": measure_leaks,
    "live": measure_live,
}


if __name__ == "__main__":
    for part in sys.argv[1:] or PARTS:
        PARTS[part]()
