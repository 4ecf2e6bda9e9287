"""The results folder: a file a row, written when the row is done, so that a killed run goes on where it was."""

import json
import os
import platform
import re
import subprocess
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from numpy.typing import NDArray
from PIL import Image

from napari_fiberburst.errors import OutputError

Row = dict[str, Any]
SCENES, ABLATION, CONDITIONS, REAL, COST = TABLES = (
    "1 scenes",
    "2 ablation",
    "3 conditions",
    "4 real burst",
    "5 cost",
)
PACKAGES = ("napari-fiberburst", "numpy", "scipy", "scikit-image", "torch", "matplotlib")


class Results:
    """Rows of tables in a folder.

    Parameters
    ----------
    folder : Path
        Made where it is missing.
    mode : str
        What kind of run it is ("full", "quick", "large"): rows of two kinds do not mix.
    resume : bool
        Keep the rows that are there, and make only those that are not.
    overwrite : bool
        Take away the rows that are there.

    Raises
    ------
    OutputError
        The folder holds results and neither `resume` nor `overwrite` says what to do with them; or they are of
        another mode.
    """

    def __init__(self, folder: Path, mode: str, *, resume: bool = False, overwrite: bool = False) -> None:
        self.folder = folder
        self._mode = mode
        about = folder / "about.json"
        if about.exists():
            before = json.loads(about.read_text(encoding="utf-8"))["mode"]
            if overwrite:
                for path in [path for made in ("rows/*/*", "pictures/*/*", "figures/*") for path in folder.glob(made)]:
                    path.unlink()
            elif not resume:
                raise OutputError(f"{folder} holds results; --resume goes on with them, --overwrite begins anew")
            elif before != mode:
                raise OutputError(
                    f"{folder} holds results of a {before} run; this is a {mode} one: name another folder"
                )
        folder.mkdir(parents=True, exist_ok=True)
        machine = describe_machine()
        self._commit = machine["commit"]  # files may change while a long run goes on; it does not see that
        write_json(about, {"mode": mode, **machine})

    def row(self, table: str, case: str, method: str, compute: Callable[[], Row], given: Row | None = None) -> Row:
        """Return a row: as it was written before from the same recipe, or computed and written now.

        Parameters
        ----------
        table, case, method : str
            Where it stands.
        compute : callable
            Makes what was found. A picture in it, (H, W) or (H, W, C) with 1 as full scale, is written beside the row
            as PNG.
        given : dict, optional
            The recipe, which becomes part of the row: the burst, and how many steps a method may take.
        """
        path = self.folder / "rows" / slug(table) / f"{slug(case)}.{slug(method)}.json"
        recipe: Row = json.loads(_as_json(given or {}))
        if path.exists():
            known: Row = json.loads(path.read_text(encoding="utf-8"))
            is_same = all(name in known and known[name] == value for name, value in recipe.items())
            if is_same and "missing" not in known:  # a peer may have been installed since
                return known
        found = {"table": table, "case": case, "method": method, **recipe, **compute()}
        picture = found.pop("picture", None)
        if picture is not None:
            drawn = self.folder / "pictures" / slug(table) / f"{slug(case)}.{slug(method)}.png"
            write_picture(drawn, picture)
        write_json(path, {**found, "commit": self._commit, "date": now()})
        return found

    def rows(self, table: str) -> Iterator[Row]:
        """Return all rows of a table that are there."""
        for path in sorted((self.folder / "rows" / slug(table)).glob("*.json")):
            yield json.loads(path.read_text(encoding="utf-8"))

    def picture(self, table: str, case: str, method: str) -> NDArray[np.uint8] | None:
        """Return a row's picture."""
        path = self.folder / "pictures" / slug(table) / f"{slug(case)}.{slug(method)}.png"
        return np.asarray(Image.open(path)) if path.exists() else None

    @property
    def about(self) -> Row:
        """What machine, versions and commit the latest run had."""
        told: Row = json.loads((self.folder / "about.json").read_text(encoding="utf-8"))
        return told


def describe_machine() -> Row:
    """Return what a run ran on."""
    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    return {
        "date": now(),
        "commit": commit(),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": psutil.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30),
        "gpu": gpu,
        "versions": {name: _version(name) for name in PACKAGES},
    }


def commit() -> str | None:
    """Return the commit of this checkout, with a plus where files differ from it; None without git."""
    here = Path(__file__).parent
    try:
        name = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=here, capture_output=True, text=True)
        changed = subprocess.run(["git", "status", "--porcelain", "-uno"], cwd=here, capture_output=True, text=True)
    except FileNotFoundError:
        return None
    return name.stdout.strip() + ("+" if changed.stdout.strip() else "") or None


def now() -> str:
    """Return the date and time, UTC; sorted, they tell the order of events."""
    return datetime.now(UTC).isoformat(sep=" ", timespec="milliseconds").removesuffix("+00:00")


def write_json(path: Path, told: Row) -> None:
    """Write plain values, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(_as_json(told), encoding="utf-8")
    os.replace(part, path)


def write_picture(path: Path, picture: NDArray[np.floating]) -> None:
    """Write a picture whose full scale is 1."""
    path.parent.mkdir(parents=True, exist_ok=True)
    levels = np.rint(np.clip(np.nan_to_num(picture), 0, 1) * 255).astype(np.uint8)
    channels = levels.shape[2] if levels.ndim == 3 else 0
    Image.fromarray(levels[..., 0] if channels == 1 else levels).save(path)


def slug(name: str) -> str:
    """Return a name that can be a file's."""
    return re.sub(r"[^a-z0-9.]+", "_", name.lower()).strip("_")


def _as_json(told: Row) -> str:
    return json.dumps(told, indent=1, default=float)


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        found = re.search(r"model name\s*:\s*(.+)", cpuinfo.read_text(encoding="utf-8"))
        if found:
            return found[1]
    return platform.processor()
