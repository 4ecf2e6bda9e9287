"""``fiberburst simulate --recording``."""

import argparse
from dataclasses import fields
from typing import Any

import numpy as np
from tqdm import tqdm

from napari_fiberburst.errors import OutputError, SettingsError
from napari_fiberburst.io.folder import read_image
from napari_fiberburst.io.results import check_place, write_whole
from napari_fiberburst.io.video_writer import VIDEO_CODECS, VIDEO_ENDINGS, write_video
from napari_fiberburst.simulation import PATHS, Faults, simulate_recording

TRUTH_ENDING = ".truth.npz"
# Of `Faults`, those that recordings have.
_FAULTS = ("flicker", "field", "overlay", "vignette")
_NUMBERS: dict[str, tuple[type, str]] = {
    "step": (float, "pixels from frame to frame, default 0.035 of the shorter side"),
    "laps": (int, "how many times the path is gone, forth and back, default 1"),
    "turn": (float, "degrees by which the probe turns on the way, default 0"),
    "zoom": (float, "by how much its magnification changes, relative, default 0"),
    "gaps": (int, "how often the probe loses contact, default 0"),
    "jumps": (int, "how often the recording is cut and goes on elsewhere, default 0"),
    "bending": (float, "by how much tissue bends over the recording, pixels, default 0"),
    "drift": (float, "by how much the light changes slowly, relative, default 0"),
    "cells": (int, "how many cells blink, default 0"),
    "rate": (float, "frames per second, default 25"),
}


def add_to(parser: argparse.ArgumentParser) -> None:
    """Add the options of recordings."""
    group = parser.add_argument_group(
        "recordings", "a video of any length instead of a burst, and the truth of it in an .npz file beside it"
    )
    group.add_argument("--recording", choices=PATHS, help="where the probe goes")
    for name, (kind, text) in _NUMBERS.items():
        group.add_argument(f"--{name}", type=kind, help=text)
    group.add_argument("--codec", choices=VIDEO_CODECS, help="default ffv1, and h264 in .mp4")


def check_absent(options: argparse.Namespace) -> None:
    """Refuse what only recordings have.

    Raises
    ------
    SettingsError
        Such an option was given.
    """
    for name in (*_NUMBERS, "codec"):
        if getattr(options, name) is not None:
            raise SettingsError(f"--{name} is of recordings; say by --recording where the probe goes")


def run(options: argparse.Namespace, bundle: dict[str, Any]) -> int:
    """Simulate and write."""
    if options.output.suffix.lower() not in VIDEO_ENDINGS:
        known = ", ".join(VIDEO_ENDINGS)
        raise OutputError(f"a recording is written to a file ending in {known}; got {options.output}")
    for item in fields(Faults):
        if item.name not in _FAULTS and getattr(options, item.name) is not None:
            raise SettingsError(f"{item.name} is a fault of bursts; recordings have {', '.join(_FAULTS)}")
    truth = options.output.with_suffix(TRUTH_ENDING)
    check_place(truth)
    given = {name: getattr(options, name) for name in ("shape", "frames", "channels", "physics", *_NUMBERS, *_FAULTS)}
    recording = simulate_recording(
        options.scene or "slide",
        path=options.recording,
        flat=None if options.flat is None else read_image(options.flat),
        seed=options.seed,
        **{name: value for name, value in given.items() if value is not None},
        **bundle,
    )
    with tqdm(total=len(recording.source), unit="frame") as bar:
        write_video(recording.source, options.output, codec=options.codec, on_frame=bar.update)
    with write_whole(truth) as stream:
        np.savez_compressed(stream, allow_pickle=False, **recording.arrays())
    print(f"wrote {options.output} and {truth}: {recording.source}")
    return 0
