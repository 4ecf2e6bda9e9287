"""``fiberburst calibrate``: a bundle, measured once and kept in a file."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_fiberburst.cli.arguments import add_frames
from napari_fiberburst.cli.info import describe
from napari_fiberburst.errors import BundleError
from napari_fiberburst.io import read_burst

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle

# Endings of files that hold one image each.
_IMAGES = (".png", ".npy")


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "calibrate",
        help="measure a bundle and keep it in a file",
        description="Measure a bundle: in a burst of a moving object, or in one or several images in even light.",
    )
    parser.add_argument(
        "input",
        type=Path,
        nargs="+",
        help="an image of the bundle in even light, which knows the gains best; several with --even; or a burst",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="a file ending in .bundle")
    parser.add_argument(
        "--even", action="store_true", help="all frames of INPUT show nothing but even light; they are averaged"
    )
    parser.add_argument(
        "--dark", type=Path, nargs="+", help="the same without the light of the object: black level, light of the cores"
    )
    add_frames(parser)
    parser.add_argument("--axes", help="order of a burst's axes, such as CTYX, where the file does not say it")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, mps")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Calibrate, write, and say what was found."""
    from napari_fiberburst.bundle.bundle import Bundle  # torch takes seconds to load

    Bundle.check_output(options.output)
    bundle = _calibrated(options)
    bundle.save(options.output)
    describe(bundle)
    print(f"wrote {options.output}")
    return 0


def _calibrated(options: argparse.Namespace) -> "Bundle":
    from napari_fiberburst.bundle.bundle import Bundle

    first, *others = options.input
    if others and not options.even:
        raise BundleError(
            f"a burst is one stack, folder or pattern; got {len(options.input)} files; add --even where they are "
            "images of the bundle in even light"
        )
    is_even = options.even or first.suffix.lower() in _IMAGES
    burst = None if is_even else read_burst(first, axes=options.axes, frames=options.frames)
    if burst is None or burst.shape[0] == 1:
        return Bundle.from_image(options.input, dark=options.dark, device=options.device)
    if options.dark is not None:
        raise BundleError(
            f"a dark image belongs to images in even light, and {first} is a burst of {burst.shape[0]} frames; add "
            "--even, or leave --dark out"
        )
    bundle = Bundle.from_burst(burst, device=options.device)
    return replace(bundle, provenance={**bundle.provenance, "files": [first.name]})
