"""``fiberburst mosaic``: one wide picture of a long recording."""

import argparse
from pathlib import Path
from typing import Any

from tqdm import tqdm

from napari_fiberburst.io import open_recording


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "mosaic",
        help="make one wide picture of a long recording",
        description="Find where every frame of a recording lies, and make one wide picture of all of them.",
    )
    parser.add_argument(
        "input", type=Path, nargs="+", help="a video, TIFF, folder or OME-Zarr; several are one recording"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        help="OUT.ome.zarr; the places of all frames go into OUT.poses.csv beside it",
    )
    parser.add_argument("--bundle", type=Path, help="probe.bundle, or an image of the bundle in even light")
    parser.add_argument(
        "--motion",
        choices=("auto", "translation", "similarity"),
        default="auto",
        help="how frames may lie: shifted, or turned and grown as well; default, as they ask for",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Make the mosaic and say what has come of it."""
    # torch takes seconds to load
    from napari_fiberburst.pipeline.reconstruct import as_bundle
    from napari_fiberburst.recordings.mosaic import check_mosaic, mosaicking

    check_mosaic(options.output)
    source = open_recording(options.input[0] if len(options.input) == 1 else options.input)
    print(source)
    steps = mosaicking(
        source,
        options.output,
        bundle=None if options.bundle is None else as_bundle(options.bundle),
        dof={"auto": None, "translation": 2, "similarity": 4}[options.motion],
        client=None,
    )
    with tqdm(total=1.0, bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}") as bar:
        while True:
            try:
                doing = next(steps)
            except StopIteration as end:
                found = end.value
                break
            bar.set_description(doing.what)
            bar.n = doing.part
            bar.refresh()
    print(f"frames placed {int((found.track.piece >= 0).sum())} of {len(found.track)}, in {found.track.pieces} pieces")
    if found.resolution is not None:
        print(f"two halves of the frames agree down to periods of {found.resolution:.1f} pixels")
    reasons = f": {'; '.join(found.notes)}" if found.notes else ""
    print(f"the mosaic is {found.quality}{reasons}")
    print(f"wrote {', '.join(map(str, found.paths))} and {found.poses}")
    return 0
