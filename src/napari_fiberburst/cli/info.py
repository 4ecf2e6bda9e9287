"""``fiberburst info``."""

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_fiberburst.cli.arguments import add_frames
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.picture import write_png
from napari_fiberburst.io.results import check_place, is_model
from napari_fiberburst.settings import Settings

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle
    from napari_fiberburst.results.model import Model


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "info",
        help="say what a burst, a recording, a bundle or a model holds",
        description="Open a burst, a recording of any length, or a bundle or model that was kept, and say what is "
        "known of it. Of a long recording, offer a burst that suits.",
    )
    parser.add_argument(
        "input",
        type=Path,
        help="TIFF, video, folder or pattern of frames, npz, OME-Zarr; probe.bundle; or scene.fiberburst",
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
    if is_model(options.input):
        return _of_model(options.input)
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


def _of_model(path: Path) -> int:
    from napari_fiberburst.results.model import Model  # the package for bundles takes a second to load

    for name, value in _facts(Model.load(path), path.stat().st_size):
        print(f"{name:15} {value}")
    return 0


def _facts(model: "Model", size: int) -> Iterator[tuple[str, str]]:
    """Return what is known of a model in a file of so many bytes, names and values."""
    taken, told = model.taken, model.diagnostics
    count, height, width, channels = taken.shape
    used = count if told.frames_used is None else len(told.frames_used)
    yield "frames", f"{count}, of which {used} take part"
    yield "height x width", f"{height} x {width}"
    yield "channels", f"{channels} {', '.join(taken.channel_names)}".strip()
    yield "image", f"{' x '.join(map(str, model.canvas.shape))} pixels"
    yield "method", f"{_choice(model.settings)}, {model.ending} in {model.seconds:.1f} s on {model.device}"
    if told.quality is not None:
        yield "verdict", told.quality
    for note in told.notes:
        yield "note", note
    if told.resolution is not None:
        yield "finest detail", f"{told.resolution:.1f} px: down to it, two halves of the burst agree"
    if told.bundle is not None:
        yield "bundle", f"{len(told.bundle.centres)} {told.bundle.pattern}, {told.bundle.pitch:.2f} pixels apart"
    # As it is reported of the published method: what the scene and its motion are drawn from, beside the burst.
    yield (
        "compression",
        f"{model.compression:.1%}: {model.parameters} numbers for {taken.nbytes / 2**20:.2f} MiB of burst",
    )
    yield "file", f"{size / 2**20:.2f} MiB, with all that the image rests on"
    versions = model.made_with.get("versions", {})
    yield "made with", ", ".join(f"{package} {version}" for package, version in versions.items())


def _choice(plain: Mapping[str, Any]) -> str:
    """Return encoding and motion of settings."""
    flat = Settings.from_dict(plain).flat()
    return f"{flat['encoding']} with motion {flat['motion']}"
