"""``fiberburst info``."""

import argparse
from pathlib import Path
from typing import Any

from napari_fiberburst.io import read_burst


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "info", help="say what a burst holds", description="Open a burst and say what is known of it."
    )
    parser.add_argument("input", type=Path, help="TIFF, folder or pattern of frames, npz, or OME-Zarr")
    parser.add_argument("--axes", help="order of the axes, such as CTYX, where the file does not say it")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read and print."""
    burst = read_burst(options.input, axes=options.axes)
    count, height, width, channels = burst.shape
    size = "unknown"
    if burst.pixel_size is not None:
        size = " x ".join(f"{side:g}" for side in burst.pixel_size) + f" {burst.unit or '(unit unknown)'}"
    times = "unknown" if burst.times is None else f"{burst.times[0]:g} to {burst.times[-1]:g} s"
    for name, value in (
        ("frames", count),
        ("height x width", f"{height} x {width}"),
        ("channels", f"{channels} {', '.join(burst.channel_names)}".strip()),
        ("pixels", f"{burst.dtype}, {burst.nbytes / 2**20:.1f} MiB; {burst.frames.nbytes / 2**20:.1f} MiB in memory"),
        ("levels", f"black {burst.black_level:g}, white {burst.white_level:g}"),
        ("brightest", f"{burst.frames.max() * (burst.white_level - burst.black_level) + burst.black_level:g}"),
        ("pixel size", size),
        ("times", times),
    ):
        print(f"{name:15} {value}")
    return 0
