"""Record the plugin at work: open a sample, press Start, and keep what the window shows as a small animation.

    python examples/record_the_plugin.py plugin.gif

Without a display, put `xvfb-run -s "-screen 0 1280x800x24"` in front.
"""

import sys
from typing import Any

import napari
from PIL import Image
from qtpy.QtCore import QEventLoop, QTimer

WIDTH, HEIGHT = 1100, 720
SHOWN_WIDTH = 880
MILLISECONDS_A_FRAME, MILLISECONDS_AT_END = 350, 3000
COLOURS = 96


def main(path: str) -> None:
    """Run the plugin on a sample and write the animation."""
    viewer = napari.Viewer()
    viewer.window.resize(WIDTH, HEIGHT)
    viewer.open_sample("napari-fiberburst", "histology_core")
    _, dock = viewer.window.add_plugin_dock_widget("napari-fiberburst", "Fiber burst reconstruction")
    frames: list[Image.Image] = []

    def take(*_: Any) -> None:
        shown = Image.fromarray(viewer.window.screenshot(canvas_only=False, flash=False)).convert("RGB")
        small = shown.resize((SHOWN_WIDTH, round(SHOWN_WIDTH * shown.height / shown.width)), Image.Resampling.LANCZOS)
        frames.append(small.quantize(COLOURS, dither=Image.Dither.NONE))

    def wait(signal: Any) -> None:
        loop = QEventLoop()
        signal.connect(loop.quit)
        loop.exec()
        signal.disconnect(loop.quit)

    def pause(milliseconds: int) -> None:
        loop = QEventLoop()
        QTimer.singleShot(milliseconds, loop.quit)
        loop.exec()

    pause(3000)  # the window is laid out, and torch loads
    viewer.reset_view()
    take()
    dock.picture.runner.previewed.connect(lambda _: QTimer.singleShot(150, take))
    dock.picture.start()
    wait(dock.picture.display.complete)
    pause(500)
    take()
    durations = [MILLISECONDS_A_FRAME] * (len(frames) - 1) + [MILLISECONDS_AT_END]
    durations[0] = 3 * MILLISECONDS_A_FRAME
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)
    print(f"wrote {path}: {len(frames)} images")
    viewer.close()


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "plugin.gif")
