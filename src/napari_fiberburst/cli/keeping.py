"""The bundle that a command leaves behind, with what its frames have told of it."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle, GainMeasurement


def add_keeping(parser: argparse.ArgumentParser, frames: str) -> None:
    """Add the option that keeps the bundle; `frames` are what has told of it."""
    parser.add_argument(
        "--keep-bundle", type=Path, help=f"write the bundle here, with what {frames} has told of it; a .bundle file"
    )


def check_keeping(options: argparse.Namespace) -> None:
    """Refuse a file that the bundle cannot be written to, before anything is read.

    Raises
    ------
    OutputError
        It does not end in .bundle, or its folder is not there.
    """
    if options.keep_bundle is not None:
        from napari_fiberburst.bundle.bundle import Bundle  # torch takes seconds to load

        Bundle.check_output(options.keep_bundle)


def keep(path: Path, measured: "GainMeasurement", known: "Bundle | None") -> None:
    """Write the bundle that was given, made better; or the one that was found."""
    found = measured.bundle
    if found is None or not found.gains_known or found.pattern == "none":
        print(f"fiberburst: the run has not measured the bundle; {path} was not written", file=sys.stderr)
        return
    bundle = found if known is None else known.updated(measured)
    bundle.save(path)
    print(f"wrote {path}")
