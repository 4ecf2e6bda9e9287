"""``fiberburst render``."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.errors import OutputError, SettingsError
from napari_fiberburst.io.picture import as_picture, write_png
from napari_fiberburst.io.results import IMAGE_ENDINGS, PICTURE_ENDING, check_output, is_picture, write_image


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "render",
        help="draw a model at any size, or as any frame sees it",
        description="Draw the scene of a model, which `fiberburst reconstruct -o scene.fiberburst` has written, "
        "without its burst.",
    )
    parser.add_argument("model", type=Path, help="scene.fiberburst, or scene.npz")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        help="image.ome.tif (what it was made with goes into image.json beside it), or image.png for a quick look",
    )
    parser.add_argument("--scale", type=float, default=1.0, help="image pixels to a frame pixel (default 1)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--frame", type=int, help="draw what this frame sees; negative ones count from the end")
    what.add_argument(
        "--bounds",
        type=float,
        nargs=4,
        metavar=("X0", "Y0", "X1", "Y1"),
        help="draw this part of the scene, in the pixels of the reference frame; it may reach beyond its field",
    )
    parser.add_argument(
        "--device", default="auto", help="where to compute: auto, cpu, cuda, cuda:1, mps (default auto)"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, draw, write."""
    endings = (*IMAGE_ENDINGS, PICTURE_ENDING)
    if not options.output.name.lower().endswith(endings):
        raise OutputError(f"an image is drawn into a file ending in {', '.join(endings)}; got {options.output}")
    target = check_output(options.output, options.model)
    # torch takes seconds to load: all that can be refused has been by now.
    from napari_fiberburst.networks.saved import load

    result = load(options.model, options.device)
    height, width = result.acquisition.shape[1:3]
    bounds = (0.0, 0.0, float(width), float(height)) if options.bounds is None else tuple(options.bounds)
    canvas = Canvas.over(bounds, options.scale)
    if options.frame is None:
        image = result.render(options.scale, bounds)
    else:
        count = len(result.homographies)
        if not -count <= options.frame < count:
            raise SettingsError(f"{options.model} has frames 0 to {count - 1}; there is no frame {options.frame}")
        image = result.frame(options.frame, options.scale)
    if is_picture(target):
        write_png(target, as_picture(image))
    else:
        taken, size = result.acquisition, result.acquisition.pixel_size
        if size is not None:  # of the image, whose pixels are others than a frame's
            steps = canvas.reference_from_image[[1, 0], [1, 0]]
            taken = replace(taken, pixel_size=(size[0] * float(steps[0]), size[1] * float(steps[1])))
        drawn = replace(result, image=image, canvas=canvas).provenance()
        seen_by = result.reference if options.frame is None else options.frame % len(result.homographies)
        write_image(target, image, taken, {**drawn, "seen_by_frame": seen_by})
    print(f"wrote {target}, {' x '.join(map(str, image.shape[:2]))} pixels")
    return 0
