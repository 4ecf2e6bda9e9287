"""How one frame of a recording lies on another: similarities between pairs of frames, each with how alike they are."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.motion.correlation import CHANCE, OverlapCorrelation
from napari_fiberburst.recordings import rows
from napari_fiberburst.recordings.views import Views
from napari_fiberburst.stored import Stored

# Pairs that are less alike than this do not show the same place.
LEAST_ALIKE = 0.35
# So many pairs are refined at once, by every second cell along each axis, in so many steps.
_TOGETHER, _STRIDE, _STEPS = 32, 2, 5
# Residuals beyond so many of their median count less.
_ROBUST = 3.0
# Pairs that are refined from where they are expected are not looked for elsewhere if they are so much alike there.
_SURELY_ALIKE = 0.6
# A pair that has to turn (radians) or to grow by more than this, beyond what is expected, was not found.
_MOST_TURN = 0.15
# Where a mask that is interpolated is at least this, it is whole.
_WHOLE = 0.99
# Of so many images the spectra are kept: half a megabyte each, or three where a pair is looked for anywhere.
_KEPT = 96


Pair = tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Links(Stored):
    """Pairs of frames that show the same place.

    Attributes
    ----------
    pairs : numpy.ndarray
        (L, 2) int, frames i and j.
    similarity : numpy.ndarray
        (L, 4) float64 a, b, x, y: pixel p of frame j lies on the pixel [[a, -b], [b, a]] p + (x, y) of frame i, both
        from the middle of the frame.
    middle, reach : numpy.ndarray
        (L, 2): the middle of what both see, pixels of frame j from its middle, and how far that reaches on each side
        (root mean square).
    alike : numpy.ndarray
        (L,) correlation of what both see, 0 to 1.
    """

    _kind: ClassVar[str] = "set of links"

    pairs: NDArray[np.int64]
    similarity: NDArray[np.float64]
    middle: NDArray[np.float64]
    reach: NDArray[np.float64]
    alike: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.pairs)

    @classmethod
    def none(cls) -> "Links":
        """Return no links."""
        two = np.zeros((0, 2))
        return cls(
            pairs=np.zeros((0, 2), np.int64), similarity=np.zeros((0, 4)), middle=two, reach=two, alike=np.zeros(0)
        )

    def __add__(self, other: "Links") -> "Links":
        return Links(**{name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _NAMES})

    def is_near(self, expected: NDArray[np.float64], radius: float) -> NDArray[np.bool_]:
        """Return which links (L,) are about as expected (L, 4): shifted by no more than a radius, hardly turned."""
        change = self.similarity - expected
        near: NDArray[np.bool_] = (np.hypot(*change[:, 2:].T) <= radius) & (np.hypot(*change[:, :2].T) < _MOST_TURN)
        return near

    def where(self, chosen: NDArray[np.bool_]) -> "Links":
        """Return some of the links."""
        return Links(**{name: getattr(self, name)[chosen] for name in _NAMES})


_NAMES = tuple(item.name for item in fields(Links))


class Linker:
    """Finds frames in one another.

    Parameters
    ----------
    views : Views
        The frames.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        self._correlation = OverlapCorrelation(views.at, views.shape, _KEPT)
        height, width = views.shape
        # Steps are told in halves of the longer side, so that a turn and a shift of one unit are alike.
        self._half = max(height, width) / 2
        y, x = torch.meshgrid(
            (torch.arange(0, height, _STRIDE) - (height - 1) / 2) / self._half,
            (torch.arange(0, width, _STRIDE) - (width - 1) / 2) / self._half,
            indexing="ij",
        )
        self._x, self._y = x.reshape(-1), y.reshape(-1)
        self._scale = torch.tensor([(width - 1) / 2, (height - 1) / 2]) / self._half

    def find(self, pairs: Sequence[Pair]) -> Links:
        """Return those of pairs that show the same place, wherever that is."""
        return self._searched(pairs, None, np.inf)

    def follow(self, pairs: Sequence[Pair], expected: NDArray[np.float64], radius: float) -> Links:
        """Return those of pairs that show the same place about where that is expected.

        Parameters
        ----------
        pairs : sequence of (int, int)
            Frames.
        expected : numpy.ndarray
            (L, 4), similarities as those of `Links`.
        radius : float
            How far from there the middle of a frame may lie, pixels.
        """
        links = self._refined(pairs, expected)
        sure = (links.alike >= np.maximum(_SURELY_ALIKE, self._by_chance(links))) & links.is_near(expected, radius)
        open_pairs = [pair for pair, is_sure in zip(pairs, sure, strict=True) if not is_sure]
        return links.where(sure) + self._searched(open_pairs, expected[~sure], radius)

    def _searched(self, pairs: Sequence[Pair], expected: NDArray[np.float64] | None, radius: float) -> Links:
        """Return pairs that correlate at some shift, refined from the best one."""
        kept, starts = [], []
        for number, pair in enumerate(pairs):
            start = np.array([1.0, 0, 0, 0]) if expected is None else expected[number].copy()
            near = None if expected is None else (start[2:] / self._views.spacing, radius / self._views.spacing)
            shift, score = self._correlation.best(*pair, near)
            if score >= LEAST_ALIKE:
                start[2:] = shift * self._views.spacing
                kept.append(pair)
                starts.append(start)
        at = np.reshape(np.array(starts, dtype=np.float64), (-1, 4))
        links = self._refined(kept, at)
        is_alike = links.alike >= np.maximum(LEAST_ALIKE, self._by_chance(links))
        return links.where(is_alike & links.is_near(at, self._half * self._views.spacing / 4))

    def _by_chance(self, links: Links) -> NDArray[np.float64]:
        """Return how alike what each pair has in common may be by chance, (L,): the fewer cores, the more."""
        cores = 12 * links.reach.prod(axis=1) / self._views.pitch**2  # an even square has its side over root 12 as rms
        alike: NDArray[np.float64] = CHANCE / np.sqrt(np.maximum(cores, 1))
        return alike

    def _refined(self, pairs: Sequence[Pair], starts: NDArray[np.float64]) -> Links:
        found = Links.none()
        for first in range(0, len(pairs), _TOGETHER):
            some = slice(first, first + _TOGETHER)
            found = found + self._refine(pairs[some], starts[some])
        return found

    def _refine(self, pairs: Sequence[Pair], starts: NDArray[np.float64]) -> Links:
        """Return the similarities of pairs from where they are expected, by inverse compositional Gauss-Newton.

        The slopes are those of the second image, so they are found once (Baker and Matthews, "Lucas-Kanade 20 years
        on", International Journal of Computer Vision 56, 2004).
        """
        first, second = (self._stacked([pair[side] for pair in pairs]) for side in (0, 1))
        moving, jacobian, inside = self._linearised(second)
        unit = np.array([1, 1, self._half * self._views.spacing, self._half * self._views.spacing])
        similarity = torch.from_numpy(starts / unit).float()
        for _ in range(_STEPS):
            there, mask = self._sampled(first, similarity)
            weight = inside * (mask > _WHOLE)
            residual = (there - rows.mean(there, weight)) - (moving - rows.mean(moving, weight))
            robust = weight / (1 + (residual / (_ROBUST * rows.rms(residual, weight))).square())
            weighted = jacobian * robust[:, None]
            normal = weighted @ jacobian.mT + 1e-3 * torch.eye(4)
            change = torch.linalg.solve(normal, (weighted @ residual[..., None]))[..., 0]
            similarity = _composed(similarity, change)
        there, mask = self._sampled(first, similarity)
        weight = inside * (mask > _WHOLE)
        mass, places = weight.sum(dim=1).clamp_min(1e-9)[:, None], torch.stack([self._x, self._y])
        middle = (weight @ places.T) / mass
        spread = (weight @ places.square().T) / mass - middle.square()
        return Links(
            pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
            similarity=similarity.double().numpy() * unit,
            middle=middle.double().numpy() * unit[2:],
            reach=spread.clamp_min(0).sqrt().double().numpy() * unit[2:],
            alike=rows.correlation(there, moving, weight).double().numpy(),
        )

    def _stacked(self, numbers: Sequence[int]) -> tuple[Tensor, Tensor]:
        images, inner = zip(
            *((self._views.at(number)[0], self._views.inner(number)) for number in numbers), strict=True
        )
        return torch.stack(images), torch.stack(inner)

    def _linearised(self, second: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return images (B, P) at the points, what a step changes in them (B, 4, P), and where they are whole."""
        images, masks = second
        along_y, along_x = torch.gradient(images, dim=(1, 2))
        at, gx, gy, inside = (part[:, ::_STRIDE, ::_STRIDE].flatten(1) for part in (images, along_x, along_y, masks))
        gx, gy = gx * self._half, gy * self._half
        x, y = self._x, self._y
        return at, torch.stack([x * gx + y * gy, x * gy - y * gx, gx, gy], dim=1), inside

    def _sampled(self, first: tuple[Tensor, Tensor], similarity: Tensor) -> tuple[Tensor, Tensor]:
        """Return first images and masks (B, P) where the points of the second ones lie on them."""
        a, b, x, y = (part[:, None] for part in similarity.T)
        places = torch.stack([a * self._x - b * self._y + x, b * self._x + a * self._y + y], dim=-1) / self._scale
        both = torch.nn.functional.grid_sample(torch.stack(first, dim=1), places[:, None], align_corners=True)
        return both[:, 0, 0], both[:, 1, 0]


def _composed(similarity: Tensor, change: Tensor) -> Tensor:
    """Return similarities (B, 4) of points that are first moved back by a change (B, 4) from the identity."""
    grown = torch.complex(1 + change[:, 0], change[:, 1])
    shift = torch.complex(change[:, 2], change[:, 3])
    turn, place = torch.complex(similarity[:, 0], similarity[:, 1]), torch.complex(similarity[:, 2], similarity[:, 3])
    turn = turn / grown
    place = place - turn * shift
    return torch.stack([turn.real, turn.imag, place.real, place.imag], dim=1)


def neighbours(frames: NDArray[np.int64], gaps: Sequence[int]) -> Iterator[Pair]:
    """Return pairs of frames that lie so many places apart in a list of frames."""
    for gap in gaps:
        yield from zip(frames[:-gap].tolist(), frames[gap:].tolist(), strict=True)
