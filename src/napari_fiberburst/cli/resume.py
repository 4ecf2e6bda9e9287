"""``fiberburst resume``: go on with a run that was cut short."""

import argparse
import os
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.results import CHECKPOINT_ENDING

# Commands that go on where they were, and the options by which they would begin anew.
_COMMANDS = ("reconstruct", "mosaic", "video", "batch")
_ANEW = {"fresh": False, "resume": True}


def add_to(commands: Any, parse: Callable[[Sequence[str]], argparse.Namespace]) -> None:
    """Add the command to the parser; `parse` reads the words of any command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "resume",
        help="go on with a run that was killed",
        description="Go on with a run that was killed or stopped, by the command that it was begun with.",
    )
    parser.add_argument(
        "path",
        type=Path,
        help="RUN.checkpoint of a fit of networks, OUT.ome.zarr of a mosaic or a video, or the folder of a batch",
    )
    parser.set_defaults(run=lambda options: run(options, parse))


def run(options: argparse.Namespace, parse: Callable[[Sequence[str]], argparse.Namespace]) -> int:
    """Give the command again, in the folder that it was given in."""
    path = options.path.resolve()
    words, folder = _of_checkpoint(path) if path.name.lower().endswith(CHECKPOINT_ENDING) else _of_work(path)
    if not words:
        raise OutputError(f"{options.path} was begun by a script: run that again, and it goes on from there")
    if words[0] not in _COMMANDS:
        raise OutputError(f"{options.path} tells of a command that cannot go on: {words[0]!r}; give it again yourself")
    if not Path(folder).is_dir():
        raise OutputError(f"the run was begun in {folder}, which is not there; give its command again yourself")
    print(f"in {folder}: {shlex.join(['fiberburst', *words])}", flush=True)
    os.chdir(folder)
    begun = parse(words)
    for name, value in _ANEW.items():
        if hasattr(begun, name):
            setattr(begun, name, value)
    if hasattr(begun, "checkpoint"):
        begun.checkpoint = path
    status: int = begun.run(begun)
    return status


def _of_checkpoint(path: Path) -> tuple[list[str], str]:
    from napari_fiberburst.pipeline.checkpoint import Checkpoint  # torch takes seconds to load

    kept = Checkpoint.load(path)
    return kept.command, kept.folder


def _of_work(path: Path) -> tuple[list[str], str]:
    from napari_fiberburst.recordings.outputs import work_of
    from napari_fiberburst.recordings.work import command_of, is_begun

    for folder in (path, work_of(path)):
        if is_begun(folder):
            return command_of(folder)
    raise OutputError(
        f"{path} is no run that was cut short; expected a .checkpoint, the output of a mosaic or video that is not "
        "finished, or the folder of a batch"
    )
