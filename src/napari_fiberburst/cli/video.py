"""``fiberburst video``: every frame of a long recording, reconstructed."""

import argparse
from pathlib import Path
from typing import Any

from napari_fiberburst.cli.keeping import check_keeping, keep
from napari_fiberburst.cli.mosaic import add_recording, opened
from napari_fiberburst.cli.work import clear, worked
from napari_fiberburst.settings.freedom import FREEDOM


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "video",
        help="reconstruct every frame of a long recording",
        description="Reconstruct every frame of a recording from those about it in time.",
    )
    add_recording(
        parser,
        "OUT.ome.zarr; the places of all frames go into OUT.poses.csv beside it, and what each core has seen into "
        "OUT.traces.zarr",
    )
    parser.add_argument("--mp4", type=Path, metavar="OUT.mp4", help="a video file to look at as well, in 8 bits")
    add_frames_shown(parser)
    parser.set_defaults(run=run)


def add_frames_shown(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how frames are shown, and what is read from them."""
    parser.add_argument(
        "--window", type=int, metavar="FRAMES", help="how many frames stand behind each; default, as the motion asks"
    )
    parser.add_argument(
        "--stabilised", action="store_true", help="let the scene stand still, and the frames move over it"
    )
    parser.add_argument(
        "--regions",
        type=Path,
        metavar="LABELS.tif",
        help="a label image on the first frame, or on the stabilised picture: means over its regions go into "
        "OUT.traces.zarr and OUT.traces.csv",
    )
    parser.add_argument(
        "--scale-bar", action="store_true", help="draw one into the film, where the size of a pixel is known"
    )


def run(options: argparse.Namespace) -> int:
    """Make the video and say what has come of it."""
    # torch takes seconds to load
    from napari_fiberburst.recordings.outputs import check_target
    from napari_fiberburst.recordings.regions import read_regions
    from napari_fiberburst.recordings.video import videoing

    check_keeping(options)
    clear(options)
    check_target(options.output, "video")
    regions = None if options.regions is None else read_regions(options.regions)
    source, bundle = opened(options)
    found = worked(
        options,
        source.shape,
        lambda client: videoing(
            source,
            options.output,
            bundle=bundle,
            dof=FREEDOM[options.motion],
            window=options.window,
            stabilised=options.stabilised,
            regions=regions,
            mp4=options.mp4,
            scale_bar=options.scale_bar,
            client=client,
        ),
    )
    print(f"frames placed {int((found.track.piece >= 0).sum())} of {len(found.track)}, each from {found.window}")
    for note in found.notes:
        print(f"note: {note}")
    if options.keep_bundle is not None:
        keep(options.keep_bundle, found, bundle)
    return 0
