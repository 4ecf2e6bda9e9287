"""``fiberburst reconstruct``."""

import argparse
import math
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from napari_fiberburst.cli.arguments import add_frames, add_settings, parse_crop, settings_of
from napari_fiberburst.cli.keeping import add_keeping, check_keeping, keep
from napari_fiberburst.control import Control
from napari_fiberburst.errors import OutputError, SettingsError
from napari_fiberburst.io import read_burst
from napari_fiberburst.io.results import check_output
from napari_fiberburst.report import check_figure, check_report, write_figure, write_report
from napari_fiberburst.settings import PublishedMethod, Settings, choose

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle

INTERRUPTED = 130


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "reconstruct",
        help="make an image from a burst",
        description="Make one clean image from a burst. Ctrl-C writes what there is; a second one ends at once.",
    )
    parser.add_argument("input", type=Path, help="TIFF, video, folder or pattern of frames, npz, or OME-Zarr")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        help="image.ome.tif (its settings go into image.json beside it), image.png for a quick look, or "
        "scene.fiberburst for all that the result has, to be drawn at any size or looked into later",
    )
    parser.add_argument("--report", type=Path, help="report.html, with all that is known of the image, in one file")
    parser.add_argument(
        "--figure", type=Path, help="figure.svg or figure.png: a captured frame beside the image, fit for a paper"
    )
    add_frames(parser)
    parser.add_argument("--crop", type=parse_crop, metavar="Y0:Y1,X0:X1", help="use this part of every frame")
    parser.add_argument("--axes", help="order of the axes, such as CTYX, where the file does not say it")
    parser.add_argument("--black-level", type=float, help="intensity that stands for no light")
    parser.add_argument(
        "--bundle",
        type=Path,
        help="probe.bundle, or an image of the bundle in even light; with it one frame is a burst",
    )
    parser.add_argument("--calibration", type=Path, help="short for --bundle with an image")
    add_keeping(parser, "this burst")
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="RUN.checkpoint",
        help="keep a fit of networks here while it runs; a run that was killed goes on from it by `fiberburst resume "
        "RUN.checkpoint`, or where the same command is given again. It is removed when the image is written",
    )
    parser.add_argument(
        "--checkpoint-every", type=float, default=60.0, metavar="SECONDS", help="from one to the next (default 60)"
    )
    parser.add_argument("--white-level", type=float, help="intensity that stands for full scale")
    add_settings(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, fit, write. Returns 130 where the fit was interrupted, though its image was written."""
    places = [path for path in (options.output, options.report, options.figure) if path is not None]
    if not places:
        raise OutputError(
            "expected somewhere to write to; add -o image.ome.tif, --report report.html or --figure figure.svg"
        )
    if options.output is not None:
        check_output(options.output, options.input)
    if options.report is not None:
        check_report(options.report)
    if options.figure is not None:
        check_figure(options.figure)
    choices = settings_of(options)
    settings = choose(**choices)
    _check(options, settings)
    keeper = None
    if options.checkpoint is not None:
        from napari_fiberburst.pipeline.checkpoint import Checkpointing, check_kept  # torch takes seconds to load

        check_kept(settings)
        keeper = Checkpointing(options.checkpoint, options.checkpoint_every, options.words)
    given = options.bundle if options.bundle is not None else options.calibration
    known = None if given is None else _opened(given)
    burst = read_burst(
        options.input,
        axes=options.axes,
        black_level=options.black_level,
        white_level=options.white_level,
        frames=options.frames,
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
            if math.isfinite(report.loss):  # there is none while the bundle is calibrated
                bar.set_postfix(loss=f"{report.loss:.4g}", refresh=False)
            bar.update(report.step - bar.n)

        result = reconstruct(burst, **choices, bundle=known, control=control, on_progress=show, checkpoint=keeper)
        if options.output is not None:
            result.save(options.output)
        if options.report is not None:
            call = shlex.join(["fiberburst", *options.words])
            write_report(result, burst, options.report, name=options.input.name, call=call)
        if options.figure is not None:
            write_figure(result, burst, options.figure)
    steps = len(result.losses)
    rate = steps / result.seconds
    print(f"{result.ending} after {steps} steps in {result.seconds:.1f} s on {result.device}, {rate:.1f} it/s")
    if result.frames_used is not None:
        print(f"frames used {len(result.frames_used)} of {len(result.homographies)}")
    if result.held_out_rmse is not None:
        print(f"samples left out are met to {result.held_out_rmse:.3g} intensity units")
    if result.resolution is not None:
        print(f"finest detail {result.resolution:.1f} px: down to it, two halves of the burst agree")
    if result.compression > 0:
        print(f"{result.parameters} parameters stand for the burst in {1 - result.compression:.1%} of its bytes")
    if result.quality is not None:
        print(f"the image is {result.quality}{'' if result.quality == 'good' else ': ' + '; '.join(result.notes)}")
    print(f"wrote {' and '.join(map(str, places))}")
    if options.keep_bundle is not None:
        if result.ending == "stopped":
            print(f"fiberburst: the run was stopped; {options.keep_bundle} was not written", file=sys.stderr)
        else:
            keep(options.keep_bundle, result, known)
    if options.checkpoint is not None and options.checkpoint.exists():
        if result.ending == "stopped":
            print(f"to go on: fiberburst resume {options.checkpoint}")
        else:
            options.checkpoint.unlink()
    return INTERRUPTED if result.ending == "stopped" else 0


def _check(options: argparse.Namespace, settings: Settings) -> None:
    """Refuse what cannot be done with bundles, before anything is read."""
    given = [name for name in ("bundle", "calibration", "keep_bundle") if getattr(options, name) is not None]
    if given[:2] == ["bundle", "calibration"]:
        raise SettingsError("--calibration is short for --bundle with an image; give one of the two")
    if given and isinstance(settings.method, PublishedMethod):
        raise SettingsError("the published method has no model of the bundle; leave the bundle out, or take auto")
    check_keeping(options)


def _opened(path: Path) -> "Bundle":
    from napari_fiberburst.pipeline.reconstruct import as_bundle

    return as_bundle(path)


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
