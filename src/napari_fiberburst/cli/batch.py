"""``fiberburst batch``: every recording of a folder, with one report."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from napari_fiberburst.cli.mosaic import add_known
from napari_fiberburst.cli.progress import followed
from napari_fiberburst.cli.video import add_frames_shown
from napari_fiberburst.cli.work import add_workers, goes_on, remembered
from napari_fiberburst.errors import OutputError
from napari_fiberburst.report.batch import write_batch
from napari_fiberburst.results.batch import Row, write_table

TASKS = ("mosaic", "video", "burst")
# Settings of a task that have an option of their own.
_SETTINGS = ("bundle", "motion", "window", "stabilised", "regions", "mp4", "scale_bar")


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "batch",
        help="do the same with every recording of a folder",
        description="Make a mosaic, a video, or one image of a good burst, of every recording of a folder, and a "
        "report of all: report.html and table.csv. A batch that was cut short goes on where it is given again.",
    )
    parser.add_argument("folder", type=Path, help="with videos, TIFF stacks, OME-Zarr or folders of frames in it")
    parser.add_argument("--task", choices=TASKS, required=True, help="what to make of each recording")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder, made where it is not there")
    parser.add_argument(
        "--settings", type=Path, metavar="FILE.toml", help="with a table of settings for each task, such as [mosaic]"
    )
    parser.add_argument("--mp4", action="store_true", help="write a film beside each video")
    add_known(parser)
    add_frames_shown(parser)
    parser.add_argument(
        "--fresh", action="store_true", help="begin anew: remove what the batch has made of these recordings"
    )
    add_workers(parser)
    parser.set_defaults(run=run, motion=None)  # what is not given is as the settings file has it


def run(options: argparse.Namespace) -> int:
    """Do the task with every recording, and say what has come of it. Returns 1 where one has failed."""
    # torch takes seconds to load
    from napari_fiberburst.recordings.batch import batching, discard_batch, read_settings, recordings_in
    from napari_fiberburst.recordings.cluster import workers

    settings = read_settings(options.settings, options.task, _given(options))
    folder, output = options.folder.resolve(), options.output.resolve()
    recordings_in(folder, output)
    _make(output)
    if options.fresh:
        discard_batch(folder, output)

    def report(rows: Sequence[Row]) -> None:
        write_batch(output / "report.html", rows, f"{options.folder.resolve().name}: {options.task}")
        write_table(output / "table.csv", rows)

    with goes_on(), workers(options.workers, options.scheduler) as client:
        steps = batching(folder, output, options.task, settings=settings, client=client, on_rows=report)
        rows = followed(remembered(steps, output, options.words))
    failed = [row for row in rows if row.verdict == "failed"]
    for row in failed:
        print(f"{row.name} failed: {'; '.join(row.notes)}")
    print(f"{len(rows) - len(failed)} of {len(rows)} recordings are done; wrote {output / 'report.html'} and table.csv")
    return 1 if failed else 0


def _given(options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings that are given on the command line, which go before those of the settings file."""
    given = {name: getattr(options, name) for name in _SETTINGS}
    return {
        name: str(value.resolve()) if isinstance(value, Path) else value
        for name, value in given.items()
        if value is not None and value is not False
    }


def _make(output: Path) -> None:
    from napari_fiberburst.recordings.work import check_unused

    check_unused(output)
    try:
        output.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder {output} cannot be made ({error}); choose another place") from error
