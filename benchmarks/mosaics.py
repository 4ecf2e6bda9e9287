"""Recordings and the mosaics of them, judged by what is written, for `benchmarks.recordings`."""

import csv
import json
import subprocess
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter, map_coordinates

from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.quality import match_levels, psnr
from napari_fiberburst.recordings.bending import basis
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.simulation import SimulatedRecording, simulate_recording

SIDE, QUICK_SIDE = 256, 128
STEP, BURST = 9.0, 20
# What frames show is compared in detail that a filtered frame has: over this, in core distances.
_SHOWN = 0.5


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
        found, true = (middles_of(of[frames], self.truth) for of in (self.placed, self.truth.homographies))
        basis = np.stack([found, np.ones_like(found)], axis=1)
        turn, shift = np.linalg.lstsq(basis, true, rcond=None)[0]
        return np.array([[turn.real, -turn.imag, shift.real], [turn.imag, turn.real, shift.imag], [0, 0, 1]])

    def missed(self, piece: int = 0) -> NDArray[np.float64]:
        """Return by how much the middle of each frame of a piece is misplaced, pixels."""
        frames = self.frames(piece)
        placed = self.similarity(piece) @ self.placed[frames]
        return np.abs(middles_of(placed, self.truth) - middles_of(self.truth.homographies[frames], self.truth))

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


def middles_of(matrices: NDArray[np.float64], truth: SimulatedRecording) -> NDArray[np.complex128]:
    """Return where matrices (T, 3, 3) take the middle of frames, x + i y, (T,)."""
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

    Attributes
    ----------
    is_quick : bool
        The same.
    side : int
        Of frames, pixels.
    """

    def __init__(self, folder: Path, is_quick: bool) -> None:
        self._folder, self.is_quick = folder, is_quick
        self.side = QUICK_SIDE if is_quick else SIDE
        self._made: dict[str, Made] = {}

    def count(self, frames: int) -> int:
        """Return how many frames stand for so many."""
        return max(BURST, frames // 10) if self.is_quick else frames

    def made(self, name: str, frames: int, *, needs_true: bool = False, **settings: Any) -> Made:
        """Return a recording, and the mosaic of it."""
        if name in self._made:
            return self._made[name]
        folder = self._folder / name
        folder.mkdir()
        settings = {"step": STEP * self.side / SIDE, **settings} if "path" not in settings else settings
        count = self.count(frames)
        truth = simulate_recording("slide", frames=count, shape=(self.side, self.side), seed=1, **settings)
        video = write_video(truth.source, folder / "frames.avi")
        np.save(folder / "true.npy", truth.homographies)
        first = (count - BURST) // 2
        burst = _once(video, "--burst", str(first), str(first + BURST))
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
