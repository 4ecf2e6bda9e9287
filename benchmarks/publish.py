"""Copy the tables and figures of a results folder to where the documentation shows them, rows and all.

The figures become WebP: they are to be looked at, and stay in the repository's history.
"""

import argparse
import re
import shutil
from pathlib import Path

from PIL import Image

from benchmarks.__main__ import RESULTS

QUALITY = 88


def main() -> None:
    """Copy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", type=Path)
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    shutil.rmtree(options.target, ignore_errors=True)
    (options.target / "figures").mkdir(parents=True)
    for path in sorted(options.results.glob("figures/*.png")):
        target = options.target / "figures" / path.with_suffix(".webp").name
        Image.open(path).convert("RGB").save(target, quality=QUALITY)
    # The tables stand beside the page that shows them, so that their links hold for both.
    tables = (options.results / "tables.md").read_text(encoding="utf-8")
    tables = re.sub(r"\(figures/(\w+)\.png\)", r"(results/figures/\1.webp)", tables)
    (options.target.parent / "tables.md").write_text(tables, encoding="utf-8")
    shutil.copytree(options.results / "rows", options.target / "rows")
    shutil.copy(options.results / "about.json", options.target)


if __name__ == "__main__":
    main()
