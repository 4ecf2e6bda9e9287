"""``fiberburst info``."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_fiberburst.cli.arguments import add_frames
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.picture import write_png
from napari_fiberburst.io.results import check_place

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "info",
        help="say what a burst, a recording or a bundle holds",
        description="Open a burst, a recording of any length, or a bundle that was kept, and say what is known of it. "
        "Of a long recording, offer a burst that suits.",
    )
    parser.add_argument(
        "input", type=Path, help="TIFF, video, folder or pattern of frames, npz, OME-Zarr; or probe.bundle"
    )
    parser.add_argument("-o", "--output", type=Path, help="draw the bundle as an image into this file, a .png")
    add_frames(parser)
    parser.add_argument("--axes", help="order of the axes, such as CTYX, where the file does not say it")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read and print."""
    is_bundle = options.input.suffix.lower() == ".bundle"
    if options.output is not None:
        if not is_bundle:
            raise OutputError(f"only a bundle is drawn, a file ending in .bundle; got {options.input}; leave -o out")
        if options.output.suffix.lower() != ".png":
            raise OutputError(f"a bundle is drawn as a .png file; got {options.output}")
        check_place(options.output)
    if is_bundle:
        return _of_bundle(options.input, options.output)
    from napari_fiberburst.cli.recording import facts  # torch takes seconds to load

    for name, value in facts(options.input, options.axes, options.frames):
        print(f"{name:15} {value}", flush=True)
    return 0


def describe(bundle: "Bundle") -> None:
    """Print what a bundle has."""
    from napari_fiberburst.bundle.summary import summary  # torch takes seconds to load

    for name, value in summary(bundle):
        print(f"{name:15} {value}")


def _of_bundle(path: Path, output: Path | None) -> int:
    from napari_fiberburst.bundle.bundle import Bundle  # torch takes seconds to load

    bundle = Bundle.load(path)
    describe(bundle)
    if output is not None:
        write_png(output, bundle.to_image())
        print(f"wrote {output}")
    return 0
