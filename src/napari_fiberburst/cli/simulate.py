"""``fiberburst simulate``."""

import argparse
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from napari_fiberburst.cli import simulate_recording
from napari_fiberburst.cli.arguments import add_parameter, parse_shape
from napari_fiberburst.errors import OutputError, SettingsError
from napari_fiberburst.io.archive import SIMULATED_ENDING
from napari_fiberburst.io.folder import read_image
from napari_fiberburst.io.results import check_place, write_whole
from napari_fiberburst.settings.parameter import parameters_of
from napari_fiberburst.simulation import ENDLESS_SCENES, MOTIONS, RECORDED_PHYSICS, SCENES, Faults, simulate

_BUNDLE_OPTIONS = ("pitch", "dead_cores", "outline")


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "simulate",
        help="make a burst, or a long recording, with known truth",
        description="Simulate a burst: frames as recorded, and the truth behind them, in one .burst file. "
        "With --recording, simulate a recording of any length as a video.",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        help="a file ending in .burst; of a recording, in .avi, .mkv or .mp4",
    )
    parser.add_argument(
        "--scene",
        choices=(*SCENES, *ENDLESS_SCENES),
        help="what is to be seen, default histology; of recordings, slide",
    )
    parser.add_argument("--shape", type=parse_shape, metavar="HxW", help="default 256x256, or that of --flat")
    parser.add_argument("--frames", type=int, help="default 20; of recordings, 400")
    parser.add_argument("--channels", type=int, help="default, the scene's own; of recordings, 1")
    parser.add_argument("--motion", choices=MOTIONS, help="how the object moves, default brownian")
    parser.add_argument(
        "--physics", choices=RECORDED_PHYSICS, help="what a core does to the light, default mask; of recordings, core"
    )
    parser.add_argument("--pitch", type=float, help="distance of cores in pixels, default 7; of recordings, 4.7")
    parser.add_argument("--dead-cores", type=float, help="part of the cores that are dark, default 0")
    parser.add_argument("--outline", choices=("frame", "circle"), help="what the cores fill, default frame")
    parser.add_argument("--flat", type=Path, help="image of a real bundle in even light, which becomes the bundle")
    parser.add_argument("--seed", type=int, default=0, help="the same seed gives the same burst")
    faults = parser.add_argument_group("faults", "what is wrong with the recording; default, nothing")
    for parameter in parameters_of(Faults).values():
        add_parameter(faults, parameter)
    simulate_recording.add_to(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Simulate and write."""
    if options.recording is not None:
        if options.motion is not None:
            raise SettingsError("a recording moves as --recording says; leave --motion out")
        return simulate_recording.run(options, _given(options, _BUNDLE_OPTIONS))
    simulate_recording.check_absent(options)
    if options.output.suffix != SIMULATED_ENDING:
        raise OutputError(
            f"a simulated burst is written with its truth to a {SIMULATED_ENDING} file; got {options.output}"
        )
    check_place(options.output)
    simulated = simulate(
        options.scene or "histology",
        shape=options.shape,
        faults=Faults(**_given(options, [item.name for item in fields(Faults)])),
        flat=None if options.flat is None else read_image(options.flat),
        seed=options.seed,
        **_given(options, ("frames", "channels", "motion", "physics", *_BUNDLE_OPTIONS)),
    )
    with write_whole(options.output) as stream:
        np.savez_compressed(stream, allow_pickle=False, **simulated.arrays())
    print(f"wrote {options.output}: {simulated.burst}")
    return 0


def _given(options: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    """Return those of the named options that were given, by name."""
    return {name: getattr(options, name) for name in names if getattr(options, name) is not None}
