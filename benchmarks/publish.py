"""Put what a results folder has into the documentation: rows, tables, figures, curves of the published start.

A row that was published before stays until it is measured anew, so that a part of the benchmark can be published. The
figures become WebP, because they are to be looked at and stay in the repository's history. A figure of images is
drawn anew only where the results folder has the images of all its rows.
"""

import argparse
import sys
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from PIL import Image

from benchmarks import figures, report
from benchmarks.__main__ import NUMBERED, RESULTS
from benchmarks.results import Results, with_earlier, write_json, write_start_curves
from benchmarks.rows import key, write_rows
from napari_fiberburst.errors import FiberBurstError, OutputError

QUALITY = 88  # of WebP, 0 to 100
# The tables that a figure shows.
SHOWN = {"scenes": 1, "convergence": 2, "conditions": 3, "real": 4, "profiles": 4}


def main() -> int:
    """Parse the arguments and publish."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.publish", description=__doc__)
    parser.add_argument("target", type=Path, help="folder; tables.md is written beside it")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder, default benchmarks/results")
    parser.add_argument("--tables", type=int, nargs="+", choices=NUMBERED, default=list(NUMBERED), help="default all")
    parser.add_argument("--overwrite", action="store_true", help="delete the published rows of these tables first")
    options = parser.parse_args()
    try:
        publish(options.results, options.target, options.tables, overwrite=options.overwrite)
    except FiberBurstError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def publish(folder: Path, target: Path, numbers: Sequence[int], *, overwrite: bool = False) -> None:
    """Merge tables of a results folder into what is published.

    Parameters
    ----------
    folder : Path
        The results folder.
    target : Path
        Where rows, figures and curves go; `tables.md` goes beside it, where the page that shows it is.
    numbers : sequence of int
        The tables, 1 to 6.
    overwrite : bool
        Delete the published rows of these tables first, where the results have rows of them.

    Raises
    ------
    OutputError
        There is nothing to publish, or it is of another kind of run than what is published.
    """
    measured, published = Results(folder), Results(target, images=folder / "images")
    found = [number for number in numbers if measured.rows(NUMBERED[number])]
    if not found and not measured.start_curves:
        raise OutputError(f"{folder} has no rows of tables {list(numbers)}; measure them by python -m benchmarks")
    before, about = published.about, measured.about
    keeps_rows = not overwrite or any(
        published.rows(table) for number, table in NUMBERED.items() if number not in found
    )
    if found and before and before["mode"] != about["mode"] and keeps_rows:
        raise OutputError(
            f"{target} has rows of a {before['mode']} run, {folder} of a {about['mode']} one; publish to another "
            "folder, or all tables with --overwrite"
        )
    for number in found:
        table = NUMBERED[number]
        kept = [] if overwrite else published.rows(table)
        # A peer that is not installed here must not cost the figures that were published of it.
        merged = {key(row): row for row in kept}
        merged |= {key(row): row for row in measured.rows(table) if "missing" not in row or key(row) not in merged}
        write_rows(published.rows_file(table), merged.values())
    if found:
        write_json(target / "about.json", with_earlier(about, before if keeps_rows else {}))
    if measured.start_curves:
        write_start_curves(target, {**published.start_curves, **measured.start_curves})
    _draw(published, [name for name in figures.FIGURES if name not in SHOWN or SHOWN[name] in found])
    tables = report.in_markdown(published)
    for name in figures.FIGURES:
        tables = tables.replace(f"(figures/{name}.png)", f"({target.name}/figures/{name}.webp)")
    (target.parent / "tables.md").write_text(tables, encoding="utf-8")
    print(f"published {', '.join(NUMBERED[number] for number in found) or 'curves'} to {target}")


def _draw(published: Results, names: Sequence[str]) -> None:
    """Draw figures, those that can be drawn, and name those that stay as they were."""
    folder = published.folder / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    drawn = set()
    for name, figure in figures.drawn(published):
        if name in names:
            Image.open(BytesIO(figures.as_png(figure))).convert("RGB").save(folder / f"{name}.webp", quality=QUALITY)
            drawn.add(name)
    for name in sorted({*names} - drawn):
        if (folder / f"{name}.webp").exists():
            print(f"{name}.webp stays as it was: the results do not have the images of all its rows")


if __name__ == "__main__":
    sys.exit(main())
