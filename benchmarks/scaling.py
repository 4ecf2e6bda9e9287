"""How time and memory of a reconstruction grow with frames and with pixels, as curves with their slopes.

    python -m benchmarks.scaling
    python -m benchmarks.scaling --frames 10 30 100 --megapixels 0.1 0.4 --publish docs

Each fit is in a process of its own. A slope is that of a straight line through the logarithms: 1 is linear. The longest
bursts take an hour on two cores; --most-minutes stops a curve before its next point is likely to take longer.
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

from benchmarks.side_by_side import HERE, fitted, inputs_of
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.simulation import Camera, make_scene, simulate

FRAMES, MEGAPIXELS = (10, 30, 100, 300, 1000), (0.1, 0.3, 1.0, 4.0, 16.0)
# What stays while the other grows.
_SIDE, _FRAMES = 160, 10
_PITCH = 5.0
# The scene is drawn for frames of this side at most; larger ones see it reflected.
_DRAWN = 1000


def main() -> int:
    """Parse the arguments, fit, print, and draw."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.scaling", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, nargs="*", default=FRAMES, help=f"of {_SIDE} x {_SIDE} pixels")
    parser.add_argument("--megapixels", type=float, nargs="*", default=MEGAPIXELS, help=f"of {_FRAMES} frames")
    parser.add_argument("--most-minutes", type=float, default=60.0, help="for one fit, default 60")
    parser.add_argument("--publish", type=Path, help="folder to write scaling_table.md and scaling.webp to")
    options = parser.parse_args()
    try:
        curves = {
            "frames": curve([(count, _SIDE, float(count)) for count in options.frames], options.most_minutes),
            "megapixels": curve(
                [(_FRAMES, 2 * round(500 * math.sqrt(size)), size) for size in options.megapixels],
                options.most_minutes,
            ),
        }
    except FiberBurstError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for name, points in curves.items():
        if len(points) > 1:
            print(f"against {name}: time grows with the power {slope(points):.2f}", flush=True)
    if options.publish is not None:
        (options.publish / "scaling_table.md").write_text(in_markdown(curves), encoding="utf-8")
        draw(curves, options.publish / "scaling.webp")
    return 0


def curve(sizes: Sequence[tuple[int, int, float]], most_minutes: float) -> list[dict[str, float]]:
    """Fit bursts of (frames, side, place on the axis) while the next one is likely to end in time."""
    points: list[dict[str, float]] = []
    for frames, side, at in sizes:
        if points and points[-1]["seconds"] * at / points[-1]["at"] > 60 * most_minutes:
            print(f"{frames} x {side} x {side} is left out: it would take more than {most_minutes:g} minutes")
            break
        points.append({"at": at, **_fit(frames, side)})
        print(
            f"{frames} x {side} x {side}: {points[-1]['seconds']:.1f} s, "
            f"{points[-1]['memory']:.1f} x the frames as float32",
            flush=True,
        )
    return points


def slope(points: Sequence[dict[str, float]]) -> float:
    """Return the power with which time grows: the slope of a straight line through the upper half of the points."""
    upper = points[(len(points) - 1) // 2 :]
    at, seconds = ([point[of] for point in upper] for of in ("at", "seconds"))
    return float(np.polyfit(np.log(at), np.log(seconds), 1)[0])


def in_markdown(curves: dict[str, list[dict[str, float]]]) -> str:
    """Return a table of all points."""
    rows = [
        f"| {point['frames']} x {point['side']} x {point['side']} | {point['seconds']:.1f} s | {point['memory']:.1f} |"
        for points in curves.values()
        for point in points
    ]
    return "\n".join(["| burst | time | memory, times the frames |", "| --- | --- | --- |", *rows]) + "\n"


def draw(curves: dict[str, list[dict[str, float]]], path: Path) -> None:
    """Draw time and memory against frames and pixels."""
    mpl.use("Agg")
    figure, axes = plt.subplots(2, len(curves), figsize=(9, 6), layout="constrained", sharex="col", squeeze=False)
    for column, (name, points) in zip(axes.T, curves.items(), strict=True):
        at = [point["at"] for point in points]
        seconds, memory = ([point[of] for point in points] for of in ("seconds", "memory"))
        column[0].loglog(at, seconds, "o-", color="#0072B2")
        column[0].loglog(at, np.array(at) / at[-1] * seconds[-1], ":", color="#999999", label="linear")
        column[0].set(ylabel="seconds")
        column[0].legend(frameon=False)
        column[1].semilogx(at, memory, "o-", color="#D55E00")
        fixed = f"{_SIDE} x {_SIDE} pixels" if name == "frames" else f"{_FRAMES} frames"
        column[1].set(xlabel=f"{name}, {fixed}", ylabel="memory, times the frames", ylim=(0, None))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _fit(frames: int, side: int) -> dict[str, float]:
    """Fit a burst in a process of its own; return seconds, and memory as a multiple of the frames as float32."""
    drawn = min(side, _DRAWN)
    made = simulate(
        make_scene("tissue", (drawn, drawn), np.random.default_rng(0)),
        shape=(side, side),
        frames=frames,
        channels=1,
        physics="core",
        pitch=_PITCH,
        camera=Camera(photons=10_000.0),
    )
    inputs = inputs_of(made, "cpu")
    del made
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "burst.npz")
        np.savez(source, **inputs)
        fit = fitted(HERE, source)
    return {"frames": frames, "side": side, "seconds": fit.seconds, "memory": fit.peak / (4 * inputs["frames"].size)}


if __name__ == "__main__":
    sys.exit(main())
