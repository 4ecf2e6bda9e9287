"""``fiberburst film``: any stack as a video file to look at."""

import argparse
from pathlib import Path
from typing import Any

from napari_fiberburst.errors import OutputError
from napari_fiberburst.io import open_recording


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "film",
        help="write any stack as a video file",
        description="Write a stack with a time axis as a video file of 8 bits, at one contrast, with a scale bar where "
        "the size of a pixel is known.",
    )
    parser.add_argument("input", type=Path, help="a TIFF stack, OME-Zarr, video or folder of frames")
    parser.add_argument("-o", "--output", type=Path, required=True, help="OUT.mp4, OUT.mkv or OUT.avi")
    parser.add_argument("--axes", help="order of the axes, such as CTYX, where the file does not say it")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Write the film."""
    from napari_fiberburst.recordings.movie import write_movie  # torch takes seconds to load

    target = film_target(options.output)
    write_movie(open_recording(options.input, axes=options.axes), target, scale_bar=True)
    print(f"wrote {target}")
    return 0


def film_target(path: Path) -> Path:
    """Return where a film goes.

    Raises
    ------
    OutputError
        A file is there already, or none can be written.
    """
    from napari_fiberburst.recordings.movie import check_movie

    target = check_movie(path)
    if target.exists():
        raise OutputError(f"{target} is there already; choose another name, or remove it")
    return target
