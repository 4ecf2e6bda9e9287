"""What commands on long recordings share: on which workers, whether to go on with what was begun, and how to stop."""

import argparse
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from napari_fiberburst.cli.progress import followed
from napari_fiberburst.cli.reconstruct import INTERRUPTED
from napari_fiberburst.errors import OutputError

if TYPE_CHECKING:
    from napari_fiberburst.recordings.work import Doing

Result = TypeVar("Result")


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where to work."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, metavar="N", help="work in so many processes on this machine")
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="work on the workers of a dask scheduler, such as tcp://10.0.0.1:8786"
    )


def add_work(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where to work, and what becomes of what is there."""
    add_workers(parser)
    begun = parser.add_mutually_exclusive_group()
    begun.add_argument(
        "--resume",
        action="store_true",
        default=True,
        help="go on with work that was begun with the same settings on the same recording (the default)",
    )
    begun.add_argument("--fresh", dest="resume", action="store_false", help="begin anew where work was begun")
    add_overwrite(parser)


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Add the option that lets an output be replaced."""
    parser.add_argument("--overwrite", action="store_true", help="replace an output that is finished")


def clear(options: argparse.Namespace) -> None:
    """Remove what the options give up: work that was begun, or an output that is finished.

    Raises
    ------
    OutputError
        What would be replaced is the recording, or no picture of ours.
    """
    from napari_fiberburst.recordings.movie import check_movie
    from napari_fiberburst.recordings.outputs import ENDING, is_beside, outputs_of, work_of
    from napari_fiberburst.recordings.work import discard, is_begun, remove

    output, folder = options.output.resolve(), work_of(options.output.resolve())
    film = getattr(options, "mp4", None)
    keep_input(options.input, output, *([] if film is None else [film]))
    if not options.resume:
        discard(folder, lambda path: is_beside(output, path) or (film is not None and path == film.resolve()))
    if options.overwrite and not is_begun(folder) and output.exists():
        if not output.name.endswith(ENDING) or not (output / "zarr.json").exists():
            raise OutputError(f"{output} is no OME-Zarr, and would be lost; choose another name, or remove it")
        for path in outputs_of(output):
            remove(path)
    if options.overwrite and film is not None:
        remove(check_movie(film, may_replace=True))


def keep_input(inputs: Sequence[Path], *outputs: Path) -> None:
    """Refuse to replace what a result is made from.

    Raises
    ------
    OutputError
        One of the outputs is an input.
    """
    for output in outputs:
        if output.resolve() in [path.resolve() for path in inputs]:
            raise OutputError(f"{output} is what the result is made from, and would be lost; choose another name")


def worked(
    options: argparse.Namespace,
    shape: tuple[int, int, int, int],
    steps: Callable[[Any | None], Generator["Doing", None, Result]],
) -> Result:
    """Do work where the options say, and return what has come of it; `steps` is given the client.

    Raises
    ------
    SystemExit
        Ctrl-C or SIGTERM: it says how to go on.
    """
    from napari_fiberburst.recordings.cluster import workers
    from napari_fiberburst.recordings.outputs import work_of

    with goes_on(), workers(options.workers, options.scheduler, shape) as client:
        return followed(remembered(steps(client), work_of(options.output.resolve()), options.words))


def remembered(
    steps: Generator["Doing", None, Result], folder: Path, words: Sequence[str]
) -> Generator["Doing", None, Result]:
    """Do steps of work in a folder, which keeps the words of the command from the first of them on, to go on by."""
    from napari_fiberburst.recordings.work import remember

    try:
        doing = next(steps)
    except StopIteration as end:
        result: Result = end.value
        return result
    remember(folder, words)
    yield doing
    return (yield from steps)


@contextmanager
def goes_on() -> Iterator[None]:
    """Say, where work is interrupted, that the same command goes on with it."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit) as error:
        print("\nfiberburst: stopped; what is done stays, and the same command goes on from there", file=sys.stderr)
        raise SystemExit(INTERRUPTED if isinstance(error, KeyboardInterrupt) else error.code) from None
