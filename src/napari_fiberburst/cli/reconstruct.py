"""``fiberburst reconstruct``."""

import argparse
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from tqdm import tqdm

from napari_fiberburst.cli.arguments import add_settings, parse_crop, settings_of
from napari_fiberburst.control import Control
from napari_fiberburst.io import read_burst
from napari_fiberburst.io.results import check_output
from napari_fiberburst.settings import choose

INTERRUPTED = 130


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "reconstruct",
        help="make a picture from a burst",
        description="Make one clean picture from a burst. Ctrl-C writes what there is; a second one ends at once.",
    )
    parser.add_argument("input", type=Path, help="TIFF, folder or pattern of frames, npz, or OME-Zarr")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        help="picture.ome.tif (its settings go into picture.json beside it), or scene.npz for the fitted networks",
    )
    parser.add_argument("--crop", type=parse_crop, metavar="Y0:Y1,X0:X1", help="use this part of every frame")
    parser.add_argument("--axes", help="order of the axes, such as CTYX, where the file does not say it")
    parser.add_argument("--black-level", type=float, help="intensity that stands for no light")
    parser.add_argument(
        "--calibration", type=Path, help="picture of the bundle with nothing but even light before it; never needed"
    )
    parser.add_argument("--white-level", type=float, help="intensity that stands for full scale")
    add_settings(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, fit, write. Returns 130 where the fit was interrupted, though its picture was written."""
    check_output(options.output, options.input)
    choices = settings_of(options)
    settings = choose(**choices)
    burst = read_burst(
        options.input, axes=options.axes, black_level=options.black_level, white_level=options.white_level
    )
    if options.crop is not None:
        burst = burst.crop(*options.crop)
    print(burst)
    # torch takes seconds to load: all that can be refused has been by now.
    from napari_fiberburst.pipeline.reconstruct import reconstruct
    from napari_fiberburst.results.progress import Progress

    control = Control()
    with stop_on_interrupt(control), tqdm(total=settings.method.iterations, unit="it") as bar:

        def show(report: Progress) -> None:
            bar.total = report.iterations
            bar.set_postfix(loss=f"{report.loss:.4g}", refresh=False)
            bar.update(report.step - bar.n)

        result = reconstruct(burst, **choices, calibration=options.calibration, control=control, on_progress=show)
        result.save(options.output)
    steps = len(result.losses)
    rate = steps / result.seconds
    print(f"{result.ending} after {steps} steps in {result.seconds:.1f} s on {result.device}, {rate:.1f} it/s")
    if result.frames_used is not None:
        print(f"frames used {len(result.frames_used)} of {len(result.homographies)}")
    if result.held_out_rmse is not None:
        print(f"samples left out are met to {result.held_out_rmse:.3g} intensity units")
    if result.resolution is not None:
        print(f"two halves of the burst agree down to periods of {result.resolution:.1f} pixels")
    if result.compression > 0:
        print(f"{result.parameters} parameters stand for the burst in {1 - result.compression:.1%} of its bytes")
    print(f"wrote {options.output}")
    return INTERRUPTED if result.ending == "stopped" else 0


@contextmanager
def stop_on_interrupt(control: Control) -> Iterator[None]:
    """Let the first Ctrl-C stop a run, and the second one end the program."""

    def stop(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        control.stop()
        print("\nfiberburst: stopping, and writing what there is; Ctrl-C again ends at once", file=sys.stderr)

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
