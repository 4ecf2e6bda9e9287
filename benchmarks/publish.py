"""Copy the tables and figures of a results folder to where the documentation shows them, rows and all.

The figures are made smaller: they are to be looked at, and stay in the repository's history.
"""

import argparse
import shutil
from pathlib import Path

from PIL import Image

from benchmarks.__main__ import RESULTS

COLOURS = 128


def main() -> None:
    """Copy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", type=Path)
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    shutil.rmtree(options.target, ignore_errors=True)
    (options.target / "figures").mkdir(parents=True)
    for path in sorted(options.results.glob("figures/*.png")):
        picture = Image.open(path).convert("RGB")
        picture.quantize(COLOURS).save(options.target / "figures" / path.name, optimize=True)
    # The page that shows the tables is one folder up.
    tables = (options.results / "tables.md").read_text(encoding="utf-8")
    (options.target / "tables.md").write_text(tables.replace("(figures/", "(results/figures/"), encoding="utf-8")
    shutil.copytree(options.results / "rows", options.target / "rows")
    shutil.copy(options.results / "about.json", options.target)


if __name__ == "__main__":
    main()
