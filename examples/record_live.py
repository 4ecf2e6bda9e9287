"""Record the live view at work: choose the simulated camera, press Start, and keep what the window shows.

    python examples/record_live.py live.gif

Without a display, put `xvfb-run -s "-screen 0 1280x800x24"` in front.
"""

import sys
from collections.abc import Callable

import napari
from PIL import Image
from qtpy.QtCore import QEventLoop, QTimer

WIDTH, HEIGHT = 1100, 720
SHOWN_WIDTH = 760
MILLISECONDS_A_FRAME, MILLISECONDS_AT_END = 250, 3000
RAW, SHARPENING = 5, 22
COLOURS = 128


def wait(until: Callable[[], bool], seconds: float) -> None:
    """Let the window live until something is so, or so many seconds have gone by."""
    loop, ticks = QEventLoop(), QTimer()
    ticks.timeout.connect(lambda: loop.quit() if until() else None)
    ticks.start(20)
    QTimer.singleShot(round(1000 * seconds), loop.quit)
    loop.exec()


def main(path: str) -> None:
    """Run the live view and write the animation."""
    viewer = napari.Viewer()
    viewer.window.resize(WIDTH, HEIGHT)
    _, dock = viewer.window.add_plugin_dock_widget("napari-fiberburst", "Fiber burst reconstruction")
    frames: list[Image.Image] = []

    def take() -> None:
        shown = Image.fromarray(viewer.window.screenshot(canvas_only=False, flash=False)).convert("RGB")
        small = shown.resize((SHOWN_WIDTH, round(SHOWN_WIDTH * shown.height / shown.width)), Image.Resampling.LANCZOS)
        frames.append(small.quantize(COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))

    def take_some(count: int) -> None:
        for _ in range(count):
            wait(lambda: False, MILLISECONDS_A_FRAME / 1000)
            take()

    wait(lambda: False, 2)
    dock.empty.live_button.click()
    dock.live.start()
    wait(lambda: "live" in viewer.layers, 60)
    take_some(RAW)
    words = dock.live.words
    learning = words.text()
    wait(lambda: words.text() != learning, 60)
    take_some(SHARPENING)
    durations = [MILLISECONDS_A_FRAME] * (len(frames) - 1) + [MILLISECONDS_AT_END]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)
    print(f"wrote {path}: {len(frames)} images")
    dock.live.stop()
    wait(lambda: dock.live.job is None, 10)
    viewer.close()


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "live.gif")
