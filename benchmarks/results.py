"""The results folder: a file a table, a row written when it is done, so that a killed run goes on where it was."""

import json
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Self

import numpy as np
import psutil
import torch
from numpy.typing import NDArray
from PIL import Image

from benchmarks.rows import Row, drop_half_line, plain, put_row, read_rows, write_whole
from napari_fiberburst.errors import OutputError

SCENES, ABLATION, CONDITIONS, REAL, COST, RECORDED = TABLES = (
    "1 scenes",
    "2 ablation",
    "3 conditions",
    "4 real burst",
    "5 cost",
    "6 as recorded",
)
PACKAGES = ("napari-fiberburst", "numpy", "scipy", "scikit-image", "torch", "matplotlib")


# What must be the same for two runs' times to be compared.
MACHINE = ("python", "system", "processor", "cores", "torch_threads", "memory_gib", "gpu", "versions")
_START_CURVES = "published_start.json"

# Where a fit stood: (step, PSNR in dB, SSIM, motion error in pixels) at several steps.
Curve = list[tuple[int, float, float, float]]


@dataclass(frozen=True)
class Results:
    """A folder of rows and images, to read.

    Attributes
    ----------
    folder : Path
        Holds ``rows/``, a JSONL file a table, and ``about.json``.
    images : Path, optional
        Where the images are, a PNG a row; default ``images/`` in the folder.
    """

    folder: Path
    images: Path | None = None

    def rows(self, table: str) -> list[Row]:
        """Return all rows of a table that are there, in the order in which they were measured first."""
        return list(read_rows(self.rows_file(table)).values())

    def rows_file(self, table: str) -> Path:
        """Return where a table's rows are."""
        return self.folder / "rows" / f"{slug(table)}.jsonl"

    def image(self, table: str, case: str, method: str) -> NDArray[np.uint8] | None:
        """Return a row's image; None where there is none."""
        path = self.image_file(table, case, method)
        return np.asarray(Image.open(path)) if path.exists() else None

    def image_file(self, table: str, case: str, method: str) -> Path:
        """Return where a row's image is."""
        return (self.images or self.folder / "images") / slug(table) / f"{slug(case)}.{slug(method)}.png"

    @property
    def about(self) -> Row:
        """What kind of run it was, and its machine, versions and commit; empty where nothing has been measured.

        `earlier` in it are the same of runs on other machines or versions, and `until` when they had ended.
        """
        return _read_json(self.folder / "about.json")

    @property
    def start_curves(self) -> dict[str, Curve]:
        """Fits of the published method from several starts, by name; see `benchmarks.published_start`."""
        return _read_json(self.folder / _START_CURVES)


class Recorder:
    """The one run that writes into a results folder; a context that leaves the folder to others when it ends.

    Parameters
    ----------
    folder : Path
        Made where it is missing.
    mode : str
        What kind of run it is ("full", "quick", "large"): rows of two kinds do not mix.
    resume : bool
        Keep the rows that are there, and measure only the others.
    overwrite : bool
        Delete the rows that are there.

    Raises
    ------
    OutputError
        The folder holds results and neither `resume` nor `overwrite` says what to do with them, they are of another
        mode, or another run is writing into the folder.
    """

    def __init__(self, folder: Path, mode: str, *, resume: bool = False, overwrite: bool = False) -> None:
        self.results = Results(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(folder)
        try:
            self._begin(mode, resume=resume, overwrite=overwrite)
        except BaseException:
            self._lock.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self._lock.close()

    def _begin(self, mode: str, *, resume: bool, overwrite: bool) -> None:
        folder, before = self.results.folder, self.results.about
        if before and overwrite:
            for path in [path for made in ("rows/*.jsonl", "images/*/*", "figures/*") for path in folder.glob(made)]:
                path.unlink()
            before = {}
        elif before and not resume:
            raise OutputError(f"{folder} holds results; --resume goes on with them, --overwrite begins anew")
        elif before and before["mode"] != mode:
            raise OutputError(
                f"{folder} holds results of a {before['mode']} run; this is a {mode} one: name another folder"
            )
        for path in sorted(folder.glob("rows/*.jsonl")):
            if drop_half_line(path):
                print(f"dropped the last line of {path}, which was not written to its end", flush=True)
        about = {"mode": mode, **describe_machine()}
        self._commit = about["commit"]  # files may change while a long run goes on; it does not see that
        write_json(folder / "about.json", with_earlier(about, before))

    def row(self, table: str, case: str, method: str, compute: Callable[[], Row], recipe: Row | None = None) -> Row:
        """Return a row: as it was written before from the same recipe, or computed and written now.

        Parameters
        ----------
        table, case, method : str
            Where it stands.
        compute : callable
            Makes what was found. An image in it, (H, W) or (H, W, C) with 1 as full scale, is written beside the rows
            as PNG.
        recipe : dict, optional
            Becomes part of the row: the burst, and how many steps a method may take.
        """
        recipe = plain(recipe or {})
        path = self.results.rows_file(table)
        known = read_rows(path).get((case, method))
        if known is not None:
            is_same = all(name in known and known[name] == value for name, value in recipe.items())
            if is_same and "missing" not in known:  # a peer may have been installed since
                return known
        found = {"table": table, "case": case, "method": method, **recipe, **compute()}
        image = found.pop("image", None)
        if image is not None:
            write_image(self.results.image_file(table, case, method), image)
        put_row(path, {**found, "commit": self._commit, "date": now()})
        return found


def with_earlier(about: Row, before: Row) -> Row:
    """Return what is known of a run, with what is known of runs before it that had another machine or versions."""
    earlier = [*before.get("earlier", []), *about.get("earlier", [])]
    if before and not _is_same_machine(before, about):
        latest = {name: value for name, value in before.items() if name != "earlier"}
        earlier.append({**latest, "until": about["date"]})
    # A folder that was published, continued and published again brings the same run twice.
    once = [one for number, one in enumerate(earlier) if one not in earlier[:number]]
    differing = [one for one in once if not _is_same_machine(one, about)]
    return {**about, "earlier": differing} if differing else about


def _is_same_machine(one: Row, other: Row) -> bool:
    return all(one[name] == other[name] for name in MACHINE)


def _locked(folder: Path) -> IO[bytes]:
    """Return a file that is this run's alone until it is closed, which the system does for a run that is killed."""
    file = (folder / "writer.lock").open("ab")
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError) as error:
        file.close()
        raise OutputError(
            f"another run is writing into {folder}; wait until it has ended, or name another folder with --results"
        ) from error
    return file


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


def write_json(path: Path, content: Row) -> None:
    """Write plain values, whole or not at all."""
    write_whole(path, json.dumps(content, indent=1, default=float).encode() + b"\n")


def write_start_curves(folder: Path, curves: dict[str, Curve]) -> None:
    """Write the fits of the published method from several starts, by name."""
    write_whole(folder / _START_CURVES, json.dumps(curves).encode() + b"\n")


def write_image(path: Path, image: NDArray[np.floating]) -> None:
    """Write an image whose full scale is 1."""
    path.parent.mkdir(parents=True, exist_ok=True)
    levels = np.rint(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8)
    channels = levels.shape[2] if levels.ndim == 3 else 0
    Image.fromarray(levels[..., 0] if channels == 1 else levels).save(path)


def slug(name: str) -> str:
    """Return a name that can be a file's."""
    return re.sub(r"[^a-z0-9.]+", "_", name.lower()).strip("_")


def _read_json(path: Path) -> Row:
    """Return what a file holds; nothing where there is no file."""
    content: Row = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return content


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
