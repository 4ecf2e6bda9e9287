"""``fiberburst mosaic``: one wide picture of a long recording."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_fiberburst.cli.keeping import add_keeping, check_keeping, keep
from napari_fiberburst.cli.work import add_work, clear, worked
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.io import open_recording
from napari_fiberburst.settings.freedom import FREEDOM

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "mosaic",
        help="make one wide picture of a long recording",
        description="Find where every frame of a recording lies, and make one wide picture of all of them. A run that "
        "was cut short goes on where it is given again.",
    )
    add_recording(parser, "OUT.ome.zarr; the places of all frames go into OUT.poses.csv beside it")
    parser.set_defaults(run=run)


def add_recording(parser: argparse.ArgumentParser, output: str) -> None:
    """Add what all commands on long recordings have: what to read, where to write, what is known, and where to work."""
    parser.add_argument(
        "input", type=Path, nargs="+", help="a video, TIFF, folder or OME-Zarr; several are one recording"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help=output)
    add_known(parser)
    add_keeping(parser, "this recording")
    add_work(parser)


def add_known(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what is known of bundle and motion."""
    parser.add_argument("--bundle", type=Path, help="probe.bundle, or an image of the bundle in even light")
    parser.add_argument(
        "--motion",
        choices=tuple(FREEDOM),
        default="auto",
        help="how frames may lie: shifted, or turned and grown as well; default, as they ask for",
    )


def opened(options: argparse.Namespace) -> tuple[FrameSource, "Bundle | None"]:
    """Return the recording that options name, and its bundle where that is given."""
    from napari_fiberburst.pipeline.reconstruct import as_bundle

    paths = [path.resolve() for path in options.input]  # workers may have another current folder
    source = open_recording(paths[0] if len(paths) == 1 else paths)
    print(source)
    return source, None if options.bundle is None else as_bundle(options.bundle)


def run(options: argparse.Namespace) -> int:
    """Make the mosaic and say what has come of it."""
    # torch takes seconds to load
    from napari_fiberburst.recordings.mosaic import mosaicking
    from napari_fiberburst.recordings.outputs import check_target

    check_keeping(options)
    clear(options)
    check_target(options.output, "mosaic")
    source, bundle = opened(options)
    found = worked(
        options,
        source.shape,
        lambda client: mosaicking(source, options.output, bundle=bundle, dof=FREEDOM[options.motion], client=client),
    )
    placed, pieces = int((found.track.piece >= 0).sum()), found.track.pieces
    print(f"frames placed {placed} of {len(found.track)}, in {'one piece' if pieces == 1 else f'{pieces} pieces'}")
    if found.resolution is not None:
        print(f"finest detail {found.resolution:.1f} px: down to it, two halves of the frames agree")
    reasons = f": {'; '.join(found.notes)}" if found.notes else ""
    print(f"the mosaic is {found.quality}{reasons}")
    print(f"wrote {' and '.join(map(str, (*found.paths, found.poses)))}")
    if options.keep_bundle is not None:
        keep(options.keep_bundle, found, bundle)
    return 0
