"""Where in a long recording a good burst is: sharp, moving, in contact."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from napari_fiberburst.bundle.pitch import find_pitch
from napari_fiberburst.bundle.samples import SATURATED
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import BurstError
from napari_fiberburst.motion.coarse import LEAST_CONFIDENCE, find_shifts

# So many places of the recording are looked at, and so many frames at each.
_PLACES, _LOOKED = 64, 5
# The pitch is found in the mean of so many frames, in so many pixels a side of their middle.
_AVERAGED, _SIDE = 16, 512
# Frames are reduced to cells of a pitch, of so many pixels where no bundle is seen, and to so many a side at most.
_PLAIN_CELL, _MOST_CELLS = 3.0, 96
# Cells darker than this part of the brightest tell nothing; a frame so dark beside the brightest is not in contact.
_DARKEST, _OUT_OF_CONTACT = 0.05, 0.25
# Detail is what varies over less than so many cells (sigma of a Gaussian).
_DETAIL = 2.0
# A burst whose object goes farther than this part of the field is one mosaic's rather than one image's.
_FARTHEST = 1 / 3
# Of frames of which so many pixels are too bright for the camera, less is thought in proportion.
_MOST_SATURATED = 0.05


def best_burst(source: FrameSource, frames: int = 20) -> range:
    """Choose a burst from a recording.

    Frames are looked at in a few dozen places, five at each. Cells of a core distance, relative to their mean over the
    recording, show the object without the honeycomb. The place is chosen that shows most detail, less where the object
    moves by under a core distance or by over a third of the field, where frames do not show the same thing, and where
    they are dark beside the others or too bright for the camera.

    Parameters
    ----------
    source : FrameSource
        Of any length.
    frames : int
        How many the burst shall have.

    Returns
    -------
    range
        The numbers of its frames; all of them where the recording is no longer than that.

    Raises
    ------
    BurstError
        A frame cannot be read.

    Examples
    --------
    >>> from napari_fiberburst import open_recording
    >>> from napari_fiberburst.simulation import simulate
    >>> recording = simulate("cat", shape=(96, 110), frames=6, pitch=6.0).burst
    >>> best_burst(open_recording(recording.frames))
    range(0, 6)
    """
    if frames < 1:
        raise BurstError(f"a burst needs at least one frame; got {frames}")
    if len(source) <= frames:
        return range(len(source))
    starts = _spread(len(source) - frames, _PLACES)
    cells = _Cells.of(source)
    offsets = _spread(frames - 1, _LOOKED)
    seen = [[cells.look(source, start + offset) for offset in offsets] for start in starts]
    scores = _scores(seen, cells)
    best = starts[int(np.argmax(scores))]
    return range(best, best + frames)


def _spread(last: int, most: int) -> list[int]:
    return sorted({round(place) for place in np.linspace(0, last, most).tolist()})


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """A frame in cells (h, w), and which part of its pixels is too bright for the camera."""

    light: NDArray[np.float32]
    saturated: float


@dataclass(frozen=True, slots=True)
class _Cells:
    """How frames are reduced to cells."""

    pitch: float
    side: int
    shape: tuple[int, int]

    @classmethod
    def of(cls, source: FrameSource) -> "_Cells":
        """Take cells as wide as the bundle's pitch, by the mean of some frames."""
        height, width = source.shape[1:3]
        rows, columns = (slice(max(0, (side - _SIDE) // 2), (side + _SIDE) // 2) for side in (height, width))
        total = np.zeros((height, width), np.float32)
        for number in _spread(len(source) - 1, _AVERAGED):
            total += source.values([number])[0].mean(axis=2)
        pitch = find_pitch(torch.from_numpy(total[rows, columns].copy())) if total.any() else None
        side = max(1, round(max(pitch or _PLAIN_CELL, max(height, width) / _MOST_CELLS)))
        return cls(pitch or _PLAIN_CELL, side, (height // side, width // side))

    def look(self, source: FrameSource, number: int) -> _Look:
        """Return a frame in cells."""
        frame = source.values([number])[0]
        (rows, columns), side = self.shape, self.side
        grey = frame.mean(axis=2)[: rows * side, : columns * side].reshape(rows, side, columns, side)
        return _Look(grey.mean(axis=(1, 3)), float((frame >= SATURATED).any(axis=2).mean()))


def _scores(seen: list[list[_Look]], cells: _Cells) -> NDArray[np.float64]:
    """Return how well the frames at each place suit, (P,)."""
    light = np.array([[look.light for look in place] for place in seen])
    mean = light.mean(axis=(0, 1))
    lit = mean > _DARKEST * mean.max()
    if not lit.any():
        return np.zeros(len(seen))
    relative = np.where(lit, light / np.where(lit, mean, 1), 0).astype(np.float32)
    brightness = light[:, :, lit].mean(axis=2)
    in_contact = brightness > _OUT_OF_CONTACT * np.quantile(brightness, 0.9)
    saturated = np.array([[look.saturated for look in place] for place in seen])
    exposed = in_contact * np.clip(2 - saturated / _MOST_SATURATED, 0, 1)
    detail = np.array([np.median([_detail(frame, lit) for frame in place]) for place in relative])
    moving = np.array([_movement(place, lit, cells) for place in relative])
    return np.asarray(detail * moving * exposed.mean(axis=1) ** 2)


def _detail(frame: NDArray[np.float32], lit: NDArray[np.bool_]) -> float:
    """Return the contrast of what varies over few cells, relative to the frame's own light."""
    known = lit.astype(np.float32)
    slow = gaussian_filter(frame * known, _DETAIL) / np.maximum(gaussian_filter(known, _DETAIL), 1e-6)
    return float((frame - slow)[lit].std() / max(float(frame[lit].mean()), 1e-6))


def _movement(place: NDArray[np.float32], lit: NDArray[np.bool_], cells: _Cells) -> float:
    """Return how well the object's movement suits, 0 to 1: about a pitch or more, and not past the field."""
    y, x = np.nonzero(lit)
    positions = torch.from_numpy(np.stack([x, y], axis=1).astype(np.float32) * cells.side)
    values = torch.from_numpy(place[:, lit])
    shape = (cells.shape[0] * cells.side, cells.shape[1] * cells.side)
    found = find_shifts(positions, values, torch.ones_like(values), shape, float(cells.side))
    tied = found.connected & (found.confidence >= LEAST_CONFIDENCE)
    if tied.sum() < 2:
        return 0.0
    way = found.shifts[tied] - found.shifts[tied][:1]
    travel = float(np.hypot(way[:, 0], way[:, 1]).max())
    far = _FARTHEST * min(shape)
    return float(tied.mean()) * min(1.0, travel / cells.pitch) * min(1.0, far / max(travel, 1e-6))
