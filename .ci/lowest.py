"""Print as constraints the lowest versions that pyproject.toml allows: python .ci/lowest.py > lowest.txt"""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
extras = ("zarr", "recordings", "cluster")  # those of a cluster's node; the dock's go with napari's own
asked = [*project["dependencies"], *(one for extra in extras for one in project["optional-dependencies"][extra])]
bounds = {}
for one in asked:
    found = re.fullmatch(r"([\w-]+)(?:\[[\w,-]+\])?>=([\d.]+)", one)
    if found:
        bounds[found[1]] = found[2]
print("\n".join(f"{name}=={lowest}" for name, lowest in sorted(bounds.items())))
