"""The command ``fiberburst``, whose commands turn bursts and recordings into images, and tell of them."""

import argparse
import io
import logging
import os
import signal
import sys
from collections.abc import Sequence

from napari_fiberburst import __version__
from napari_fiberburst.cli import (
    batch,
    calibrate,
    demo,
    film,
    info,
    live,
    mosaic,
    reconstruct,
    render,
    resume,
    simulate,
    video,
)
from napari_fiberburst.cli.reconstruct import INTERRUPTED
from napari_fiberburst.errors import FiberBurstError

TERMINATED = 143
UNREAD = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status.

    0; 2 for input it cannot use; 130 when interrupted; 141 where nobody reads on, as behind ``| head``.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack signs, such as that of the micrometre
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            return _run(sys.argv[1:] if arguments is None else list(arguments))
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        # What is left to be written would fail again when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD


def _run(words: list[str]) -> int:
    logging.basicConfig(format="fiberburst: %(message)s", level=logging.WARNING)
    options = _parsed(words)
    # A run that is told to end, as by a batch queue, takes its half-written files with it.
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(TERMINATED))
    try:
        status: int = options.run(options)
    except FiberBurstError as error:
        print(f"fiberburst: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nfiberburst: interrupted; nothing was written", file=sys.stderr)
        return INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, before)
    return status


def _parsed(words: Sequence[str]) -> argparse.Namespace:
    return _parser().parse_args(words, argparse.Namespace(words=list(words)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="fiberburst",
        description="Turn frames through a fibre bundle into one clean image.",
    )
    parser.add_argument("--version", action="version", version=f"napari-fiberburst {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for command in (reconstruct, render, mosaic, video, film, live, batch, calibrate, simulate, demo, info):
        command.add_to(commands)
    resume.add_to(commands, _parsed)
    return parser
