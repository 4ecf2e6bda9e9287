"""What mosaics of long recordings reach, beside what is wanted of them.

    python -m benchmarks.recordings
    python -m benchmarks.recordings --quick --cases raster turning
    python -m benchmarks.recordings --publish docs

Every recording is simulated, so that its truth is exact, and written as FFV1, which loses nothing; each mosaic is made
of that file in a process of its own, so that neither the simulator's time nor its memory counts. Times are ratios to
`reconstruct` of a burst of 20 frames in a row out of the same file, in a process of its own right before, because
machines are shared and noisy. What a mosaic is worth is judged by its OME-Zarr and its table of poses alone,
a core distance inside its rim:

- places of frames after the one similarity that brings their middles closest to the true ones, because a mosaic has no
  frame of its own;
- PSNR beside the object itself, at the points where that similarity says that the pixels look, after one gain and
  offset;
- of tissue that bends there is no one truth: each pixel is held to the object at the point where the frames that have
  seen it look on average, at their places in the mosaic, bent as the track has them. So its geometry is free, and what
  is left is what frames that disagree have blurred.

Ends with status 1 where a goal is missed; --quick, smaller and shorter, shows that all of it runs and is held to none.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter, map_coordinates

from benchmarks.results import describe_machine, now
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.quality import match_levels, psnr, ring_correlation
from napari_fiberburst.recordings.bending import basis
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.simulation import SimulatedRecording, simulate_recording

TABLE, FIGURES = "recordings_table.md", "recordings.json"
_SIDE, _QUICK_SIDE = 256, 128
_STEP, _BURST = 9.0, 20
_GIB = 2**30
# What frames show is compared in detail that a filtered frame has: over this, in core distances.
_SHOWN = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One figure.

    Attributes
    ----------
    case, what : str
        Of which recording, and what it is.
    found : float
        The figure.
    goal : float or None
        What it is wanted to be at most; None where it is only told.
    unit : str
        "px", "dB", "x", "GiB" or "".
    """

    case: str
    what: str
    found: float
    goal: float | None = None
    unit: str = ""

    @property
    def is_met(self) -> bool:
        """Whether it is as wanted."""
        return self.goal is None or self.found <= self.goal

    @property
    def cells(self) -> tuple[str, ...]:
        """As a line of a table."""
        goal = "" if self.goal is None else f"{self.goal:g} {self.unit}"
        met = "" if self.goal is None else ("yes" if self.is_met else "**no**")
        return self.case, self.what, f"{self.found:.3g} {self.unit}".strip(), goal.strip(), met


@dataclass(frozen=True, kw_only=True, eq=False)
class Made:
    """A recording and the mosaic of it.

    Attributes
    ----------
    truth : SimulatedRecording
        The recording.
    folder : Path
        With ``wide.ome.zarr``, ``wide.poses.csv`` and further pieces.
    cost : dict
        As `benchmarks.mosaic_once` writes it.
    burst : dict
        The same of a burst of the recording.
    """

    truth: SimulatedRecording
    folder: Path
    cost: dict[str, Any]
    burst: dict[str, Any]

    @cached_property
    def piece(self) -> NDArray[np.int64]:
        """(T,) the piece of each frame; -1 for those that are in none."""
        return np.array([int(row["piece"] or -1) for row in self._table])

    @cached_property
    def placed(self) -> NDArray[np.float64]:
        """(T, 3, 3), frame pixel to pixel of the piece's picture; NaN for frames that are in none."""
        entries = [[float(row[f"h{i}{j}"] or "nan") for i in range(3) for j in range(3)] for row in self._table]
        return np.array(entries).reshape(-1, 3, 3)

    @cached_property
    def track(self) -> Track:
        """Places of frames as the package keeps them, with how frames bend, which the table does not say."""
        return Track.load(self.folder / "track.safetensors")

    @cached_property
    def _table(self) -> list[dict[str, str]]:
        with (self.folder / "wide.poses.csv").open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    @cached_property
    def _planes(self) -> NDArray[np.float64]:
        return self.track.planes()

    def picture(self, piece: int = 0) -> NDArray[np.float64]:
        """Return the picture of a piece (H, W), full scale 1."""
        return self._read("wide.ome.zarr" if piece == 0 else f"wide-{piece + 1}.ome.zarr")

    @property
    def at_true_places(self) -> NDArray[np.float64]:
        """The picture (H, W) that true places make."""
        return self._read("true.ome.zarr")

    def _read(self, name: str) -> NDArray[np.float64]:
        known = self.truth.source.acquisition
        light = np.asarray(zarr.open_array(self.folder / name / "0", mode="r"), np.float64)
        picture: NDArray[np.float64] = (light - known.black_level) / (known.white_level - known.black_level)
        return picture

    def frames(self, piece: int = 0) -> NDArray[np.int64]:
        """Return the numbers of a piece's frames."""
        return np.flatnonzero(self.piece == piece)

    def similarity(self, piece: int = 0) -> NDArray[np.float64]:
        """Return (3, 3), pixel of the piece's picture to frame-0 pixel, which brings frames' middles closest."""
        frames = self.frames(piece)
        found, true = (_middles(of[frames], self.truth) for of in (self.placed, self.truth.homographies))
        basis = np.stack([found, np.ones_like(found)], axis=1)
        turn, shift = np.linalg.lstsq(basis, true, rcond=None)[0]
        return np.array([[turn.real, -turn.imag, shift.real], [turn.imag, turn.real, shift.imag], [0, 0, 1]])

    def missed(self, piece: int = 0) -> NDArray[np.float64]:
        """Return by how much the middle of each frame of a piece is misplaced, pixels."""
        frames = self.frames(piece)
        placed = self.similarity(piece) @ self.placed[frames]
        return np.abs(_middles(placed, self.truth) - _middles(self.truth.homographies[frames], self.truth))

    def psnr(self) -> float:
        """Return PSNR of the largest piece's picture, dB."""
        return self._psnr_of(self.picture(), self.similarity())

    def psnr_at_true_places(self) -> float:
        """Return that of the picture that true places make: of frame 0's pixels, from the first that any frame sees."""
        corners = _corners(self.truth, self.truth.homographies[self.frames()]).reshape(-1, 2)
        x, y = np.floor(corners.min(axis=0))
        return self._psnr_of(self.at_true_places, np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]]))

    def _psnr_of(self, picture: NDArray[np.float64], frame_from_picture: NDArray[np.float64]) -> float:
        known = self._inside(picture)
        y, x = np.nonzero(known)
        points = transform_points(frame_from_picture, np.stack([x, y], axis=1).astype(np.float64))
        return psnr(picture[known][None], self.truth.world.sample(points)[:, 0][None])

    def seen_on_average(self) -> NDArray[np.float64]:
        """Return where the frames look that have seen each pixel of the largest piece, (H, W, 2), frame-0 pixels."""
        shape = self.picture().shape
        total, count = np.zeros((*shape, 2)), np.zeros(shape)
        height, width = self.truth.source.shape[1:3]
        for frame in self.frames():
            pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
            looks = transform_points(self.truth.homographies[frame], pixels.reshape(-1, 2)).reshape(pixels.shape)
            bent = self.truth.displacement(int(frame))
            looks = looks if bent is None else looks + bent
            corners = _corners(self.truth, self.placed[frame][None])[0]
            (left, top), (right, bottom) = np.ceil(corners.min(axis=0)), np.floor(corners.max(axis=0))
            rows = np.arange(max(0, int(top)), min(shape[0], int(bottom) + 1))
            columns = np.arange(max(0, int(left)), min(shape[1], int(right) + 1))
            places = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
            x, y = self._pixels_at(int(frame), places).T
            inside = ((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)).reshape(len(rows), len(columns))
            part = np.ix_(rows, columns)
            at = [map_coordinates(looks[..., axis], (y, x), order=1, mode="nearest") for axis in range(2)]
            total[part] += np.stack(at, axis=-1).reshape(*inside.shape, 2) * inside[..., None]
            count[part] += inside
        return np.where(count[..., None] > 0, total / np.maximum(count, 1)[..., None], np.nan)

    def _pixels_at(self, frame: int, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels (n, 2) of a frame that lie at places (n, 2) of its picture, bent as the frame is."""
        back = np.linalg.inv(self.placed[frame])
        pixels: NDArray[np.float64] = transform_points(back, places)
        if self.track.control is None:
            return pixels
        height, width = self.truth.source.shape[1:3]
        control = torch.from_numpy(self.track.control[frame])
        flat, plane = self.track.scene_from_frame[frame], self.placed[frame]
        # The picture begins where the table says that the plane nearest to the bent frame lies.
        origin = (self._planes[frame] - plane)[:2, 2]
        for _ in range(2):
            inside = np.clip(pixels, 0, (width - 1, height - 1))
            shown = basis(self.track.shape, torch.from_numpy(inside.astype(np.float32)))
            bent = transform_points(flat, inside) + (control @ shown.T).T.double().numpy() - origin
            pixels = transform_points(back, places - (bent - transform_points(plane, inside)))
        return pixels

    def psnr_with_free_geometry(self) -> float:
        """Return PSNR of the largest piece's picture beside the object where frames look on average, dB."""
        picture, points = self.picture(), self.seen_on_average()
        known = self._inside(picture) & np.isfinite(points).all(axis=-1)
        return psnr(picture[known][None], self.truth.world.sample(points[known])[:, 0][None])

    def _inside(self, known: NDArray[Any]) -> NDArray[np.bool_]:
        """Return the pixels (H, W) of a mask or a picture that lie a core distance inside what is known.

        At the very rim each pixel rests on the half of one core that happens to lie there.
        """
        reach = 2 * round(self.truth.bundle.pitch) + 1
        mask = known if known.dtype == bool else np.isfinite(known)
        inside: NDArray[np.bool_] = binary_erosion(mask, np.ones((reach, reach), bool))
        return inside

    def unmet(self) -> NDArray[np.float64]:
        """Return by how much each placed frame differs from its picture seen through its pose, of its contrast.

        Root mean square over the pixels that are visible, and known in the picture, a core distance inside of both,
        after a gain and offset; both smoothed as vendors smooth.
        """
        sigma = _SHOWN * self.truth.bundle.pitch
        pictures = {piece: self.picture(piece) for piece in range(int(self.piece.max()) + 1)}
        smooth = {
            piece: np.where(self._inside(one), _smoothed(one, np.isfinite(one), sigma), np.nan)
            for piece, one in pictures.items()
        }
        height, width = self.truth.source.shape[1:3]
        visible = np.ones((height, width), bool) if self.truth.visible is None else self.truth.visible
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(np.float64)
        found = []
        for frame in np.flatnonzero(self.piece >= 0).tolist():
            shown = _smoothed(self.truth.source.values([frame])[0, ..., 0].astype(np.float64), visible, sigma).ravel()
            x, y = transform_points(self.placed[frame], pixels).T
            seen = map_coordinates(smooth[int(self.piece[frame])], (y, x), order=1, cval=np.nan)
            known = np.isfinite(seen) & self._inside(visible).ravel()
            missed = match_levels(seen[known][None], shown[known][None])[0] - shown[known]
            found.append(float(missed.std() / shown[known].std()))
        return np.array(found)


def _smoothed(picture: NDArray[np.float64], known: NDArray[np.bool_], sigma: float) -> NDArray[np.float64]:
    weight = gaussian_filter(known.astype(np.float64), sigma)
    smooth: NDArray[np.float64] = gaussian_filter(np.where(known, picture, 0), sigma) / np.maximum(weight, 1e-9)
    return smooth


def _middles(matrices: NDArray[np.float64], truth: SimulatedRecording) -> NDArray[np.complex128]:
    height, width = truth.source.shape[1:3]
    x, y = transform_points(matrices, np.array([[(width - 1) / 2, (height - 1) / 2]]))[:, 0].T
    return np.asarray(x + 1j * y, np.complex128)


def _corners(truth: SimulatedRecording, matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    height, width = truth.source.shape[1:3]
    outer = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    corners: NDArray[np.float64] = transform_points(matrices, outer)
    return corners


class Bench:
    """Makes recordings and their mosaics; each once.

    Parameters
    ----------
    folder : Path
        For videos and mosaics.
    is_quick : bool
        Smaller frames, and fewer.
    """

    def __init__(self, folder: Path, is_quick: bool) -> None:
        self._folder, self.is_quick = folder, is_quick
        self._side = _QUICK_SIDE if is_quick else _SIDE
        self._made: dict[str, Made] = {}

    def count(self, frames: int) -> int:
        """Return how many frames stand for so many."""
        return max(_BURST, frames // 10) if self.is_quick else frames

    def made(self, name: str, frames: int, *, needs_true: bool = False, **settings: Any) -> Made:
        """Return a recording, and the mosaic of it."""
        if name in self._made:
            return self._made[name]
        folder = self._folder / name
        folder.mkdir()
        settings = {"step": _STEP * self._side / _SIDE, **settings} if "path" not in settings else settings
        count = self.count(frames)
        truth = simulate_recording("slide", frames=count, shape=(self._side, self._side), seed=1, **settings)
        video = write_video(truth.source, folder / "frames.avi")
        np.save(folder / "true.npy", truth.homographies)
        first = (count - _BURST) // 2
        burst = _once(video, "--burst", str(first), str(first + _BURST))
        more = ["--poses", str(folder / "true.npy")] if needs_true else []
        cost = _once(video, "--mosaic", str(folder / "wide.ome.zarr"), *more)
        video.unlink()
        self._made[name] = Made(truth=truth, folder=folder, cost=cost, burst=burst)
        return self._made[name]

    @property
    def raster(self) -> Made:
        """The recording that others are held to."""
        return self.made("raster", 400, needs_true=True)


def _once(video: Path, *arguments: str) -> dict[str, Any]:
    result = video.with_name("result.json")
    command = [sys.executable, "-m", "benchmarks.mosaic_once", str(video), str(result), *arguments]
    ended = subprocess.run(command, capture_output=True, text=True)
    if ended.returncode:
        words = ended.stderr.strip().splitlines() or [f"exit status {ended.returncode}"]
        raise FiberBurstError(f"the mosaic of {video.parent.name} failed: {words[-1]}")
    found: dict[str, Any] = json.loads(result.read_text(encoding="utf-8"))
    return found


def places(name: str, made: Made, median: float | None, worst: float | None) -> list[Row]:
    """Return how well the frames of the largest piece are placed, and how many of all are."""
    missed = made.missed()
    return [
        Row(case=name, what="places of frames, median", found=float(np.median(missed)), goal=median, unit="px"),
        Row(case=name, what="places of frames, worst", found=float(missed.max()), goal=worst, unit="px"),
        Row(case=name, what="frames not in the largest piece", found=len(made.piece) - len(missed)),
    ]


def cost(name: str, made: Made, most: float | None, memory: float | None) -> list[Row]:
    """Return what a mosaic costs."""
    return [
        Row(case=name, what=f"{of} beside a burst's", found=made.cost[key] / made.burst[key], goal=goal, unit="x")
        for key, of, goal in (("cpu", "processor time", most), ("wall", "time", None))
    ] + [Row(case=name, what="peak memory", found=made.cost["peak"] / _GIB, goal=memory, unit="GiB")]


def raster(bench: Bench) -> list[Row]:
    """Measure 400 frames over a slide, row by row."""
    name, made = "raster, 400 frames", bench.raster
    lost = made.psnr_at_true_places() - made.psnr()
    return [
        *places(name, made, 0.15, 0.6),
        Row(case=name, what="PSNR", found=made.psnr(), unit="dB"),
        Row(case=name, what="PSNR lost to true places", found=lost, goal=0.8, unit="dB"),
        *cost(name, made, 8.0, 1.0),
    ]


def turning(bench: Bench) -> list[Row]:
    """Measure a probe that turns and whose magnification changes."""
    made = bench.made("turning", 400, turn=3.0, zoom=0.02)
    return places("turns by 3 degrees, zoom 2 %", made, 0.3, 1.0)


def longer(bench: Bench) -> list[Row]:
    """Measure how time grows with frames."""
    name, made = "raster, 1000 frames", bench.made("longer", 1000)
    grown = made.cost["cpu"] / bench.raster.cost["cpu"]
    row = Row(case=name, what="processor time beside that of 400", found=grown, goal=2.6, unit="x")
    return [*places(name, made, None, None), row, *cost(name, made, None, 1.0)]


def longest(bench: Bench) -> list[Row]:
    """Measure how memory grows with frames."""
    name, made = "raster, 4000 frames", bench.made("longest", 4000)
    return [*places(name, made, None, None), *cost(name, made, None, 1.0)]


def loop(bench: Bench) -> list[Row]:
    """Measure a circle that comes back to where it began."""
    count, side = bench.count(1000), _QUICK_SIDE if bench.is_quick else _SIDE
    angle = 2 * np.pi * np.arange(count) / (count - 1)
    radius = _STEP * side / _SIDE * count / (2 * np.pi)
    path = np.tile(np.eye(3), (count, 1, 1))
    path[:, 0, 2], path[:, 1, 2] = radius * np.sin(angle), radius * (1 - np.cos(angle))
    made = bench.made("loop", 1000, path=path)
    name, frames = "loop of 1000 frames", made.frames()
    found = _middles((made.similarity() @ made.placed)[frames[[0, -1]]], made.truth)
    true = _middles(made.truth.homographies[frames[[0, -1]]], made.truth)
    gap = float(abs((found[1] - found[0]) - (true[1] - true[0])))
    return [Row(case=name, what="does not close by", found=gap, goal=0.2, unit="px"), *places(name, made, None, None)]


def bending(bench: Bench) -> list[Row]:
    """Measure tissue that bends slowly."""
    name, made = "bends by 3 px", bench.made("bending", 400, bending=3.0)
    lost = bench.raster.psnr_with_free_geometry() - made.psnr_with_free_geometry()
    return [
        Row(case=name, what="PSNR lost, with the geometry free", found=lost, goal=1.5, unit="dB"),
        *places(name, made, None, None),
    ]


def laps(bench: Bench) -> list[Row]:
    """Measure what is gained where a path is gone ten times."""
    name, rows, periods = "40 frames, 10 times over", [], []
    for times in (1, 10):
        made = bench.made(f"laps-{times}", 40 * times, laps=times)
        resolution = _resolution(made)
        periods.append(resolution)
        rows += [
            Row(case=name, what=f"finest period shown after {times} laps", found=resolution, unit="px"),
            Row(case=name, what=f"PSNR after {times} laps", found=made.psnr(), unit="dB"),
        ]
    gained = Row(
        case=name, what="finest period beside that of 1 lap", found=periods[1] / periods[0], goal=1.0, unit="x"
    )
    return [gained, *rows]


def _resolution(made: Made) -> float:
    """Return the finest period at which picture and object agree, by Fourier ring correlation, pixels."""
    picture = made.picture()
    rows, columns = picture.shape
    height, width = (side // 2 for side in made.truth.source.shape[1:3])
    x, y = _middles(made.placed[made.frames()], made.truth).mean().real, rows / 2
    top, left = max(0, round(y - height / 2)), max(0, round(float(x) - width / 2))
    part = (slice(top, min(rows, top + height)), slice(left, min(columns, left + width)))
    places_of = np.stack(np.meshgrid(np.arange(columns)[part[1]], np.arange(rows)[part[0]]), axis=-1)
    points = transform_points(made.similarity(), places_of.reshape(-1, 2).astype(np.float64))
    object_there = made.truth.world.sample(points)[:, 0].reshape(places_of.shape[:2])
    return ring_correlation(np.nan_to_num(picture[part]), object_there).resolution


def far(bench: Bench) -> list[Row]:
    """Measure long steps."""
    made = bench.made("far", 150, step=23.0 * (0.5 if bench.is_quick else 1.0))
    return places("steps of 23 px, 150 frames", made, None, None)


def filtered(bench: Bench) -> list[Row]:
    """Measure what an endomicroscope's display shows, with lost contact and a cut."""
    made = bench.made(
        "filtered", 400, step=_STEP, path="handheld", physics="filtered", field=0.95, overlay=True, gaps=1, jumps=1
    )
    name, unmet = "filtered, round field, a gap and a cut", made.unmet()
    count = int(made.piece.max()) + 1
    worst = max(float(made.missed(piece).max()) for piece in range(count))
    return [
        Row(case=name, what="pieces", found=count),
        Row(case=name, what="frame misplaced in its piece by, worst", found=worst, goal=1.0, unit="px"),
        Row(
            case=name,
            what="frame differs from the mosaic there, of its contrast, median",
            found=float(np.median(unmet)),
        ),
        Row(case=name, what="the same, worst", found=float(unmet.max())),
        *places(name, made, None, None),
        Row(case=name, what="frames that are out of contact", found=int((~made.truth.in_contact).sum())),
    ]


CASES: Mapping[str, Callable[[Bench], list[Row]]] = {
    "raster": raster,
    "turning": turning,
    "longer": longer,
    "loop": loop,
    "bending": bending,
    "laps": laps,
    "far": far,
    "filtered": filtered,
    "longest": longest,
}


def main() -> int:
    """Parse the arguments, measure, print, and publish."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.recordings",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="smaller and shorter, to see that all of it runs")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), help="default all")
    parser.add_argument("--publish", type=Path, help=f"folder for {TABLE} and {FIGURES}; cases not measured anew stay")
    options = parser.parse_args()
    measured: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), options.quick)
        for case in options.cases:
            before = os.getloadavg()[0]
            try:
                rows = CASES[case](bench)
            except FiberBurstError as error:
                print(f"error: {error}", file=sys.stderr)
                return 2
            measured[case] = {
                "rows": [asdict(row) for row in rows],
                "load": [before, os.getloadavg()[0]],
                "when": now(),
                "machine": describe_machine(),
            }
            print("\n".join(_line(row) for row in rows), flush=True)
            if options.publish is not None and not options.quick:
                publish(options.publish, measured)
    missed = [row for known in measured.values() for row in map(_row, known["rows"]) if not row.is_met]
    return 1 if missed and not options.quick else 0


def publish(folder: Path, measured: Mapping[str, Any]) -> None:
    """Write the figures, and their table for the documentation; what was not measured anew stays."""
    path = folder / FIGURES
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    known = {case: {**known, **measured}[case] for case in CASES if case in {**known, **measured}}
    path.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    lines = ["| recording | what | found | wanted, at most | met |", "| --- | --- | --- | --- | --- |"]
    lines += [_line(_row(row)) for one in known.values() for row in one["rows"]]
    (folder / TABLE).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _row(values: Mapping[str, Any]) -> Row:
    return Row(**values)


def _line(row: Row) -> str:
    return f"| {' | '.join(row.cells)} |"


if __name__ == "__main__":
    sys.exit(main())
