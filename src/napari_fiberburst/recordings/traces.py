"""What every core of a bundle has seen in every frame: all that is needed of a recording, at a tenth of its size."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.samples import Samples, contrast_and_glare, in_grey, sample_cores, shows_something
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.recordings.places import mean_over_places
from napari_fiberburst.recordings.work import Doing, Work, complete
from napari_fiberburst.stored import Stored

# The stage that makes traces.
TRACES = "traces"
# Frames to a part, which is what one unit of work makes and what is read from the disk at once.
PART = 64
# So many parts are kept in memory.
KEPT_PARTS = 32
# Bytes of frames that are looked at together.
_BYTES_TOGETHER = 2**26


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TracePart(Stored):
    """What the cores have seen in some frames in a row.

    Attributes
    ----------
    values : Tensor
        (n, N, C), as those of `Samples`.
    weights : Tensor
        (n, N), as those of `Samples`.
    contrast : Tensor
        (n,), standard deviation of each frame's pixels, full scale 1.
    glare : Tensor
        (n,), part of each frame's pixels that are over-exposed.
    """

    _kind: ClassVar[str] = "part of traces"

    values: Tensor
    weights: Tensor
    contrast: Tensor
    glare: Tensor


def trace_part(source: FrameSource, bundle: Bundle, number: int) -> TracePart:
    """Sample one part of a recording by the cores of a bundle, at the place where it is in these frames."""
    first = number * PART
    last = min(first + PART, len(source))
    together = max(1, _BYTES_TOGETHER // (4 * int(np.prod(source.shape[1:]))))
    found = []
    for start in range(first, last, together):
        frames = torch.from_numpy(source.values(range(start, min(start + together, last))))
        samples = sample_cores(frames, bundle, source.acquisition)
        found.append((samples.values, samples.weights, *contrast_and_glare(in_grey(frames))))
    values, weights, contrast, glare = (torch.cat(part) for part in zip(*found, strict=True))
    return TracePart(values=values, weights=weights, contrast=contrast, glare=glare)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Summary(Stored):
    """What is known of all frames.

    Attributes
    ----------
    contrast, glare : Tensor
        (T,), as those of `TracePart`.
    mean_light : Tensor
        (N,), the mean of what each core has seen, grey, over the places where it was.
    """

    _kind: ClassVar[str] = "summary of traces"

    contrast: Tensor
    glare: Tensor
    mean_light: Tensor

    @classmethod
    def of(cls, part: Callable[[int], TracePart], count: int) -> "Summary":
        """Return the summary of so many parts, each given by its number."""
        told = [(one.contrast, one.glare) for one in map(part, range(count))]
        contrast, glare = (torch.cat(one) for one in zip(*told, strict=True))
        frames = np.flatnonzero(shows_something(contrast, glare).numpy())
        return cls(contrast=contrast, glare=glare, mean_light=mean_over_places(lambda at: _light_of(part, at), frames))

    @property
    def shows(self) -> NDArray[np.bool_]:
        """(T,) bool, frames that show something: not all black, white or even."""
        shown: NDArray[np.bool_] = shows_something(self.contrast, self.glare).numpy()
        return shown


def _light_of(part: Callable[[int], TracePart], number: int) -> tuple[Tensor, Tensor]:
    one, row = part(number // PART), number % PART
    return one.values[row].mean(dim=1), one.weights[row]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Traces:
    """One value a core and frame.

    Attributes
    ----------
    template : Samples
        Of no frame: what all frames have in common.
    summary : Summary
        Of all frames.
    part : callable
        Gives each part by its number; it is asked for the same ones again and again.
    """

    template: Samples
    summary: Summary
    part: Callable[[int], TracePart]

    @classmethod
    def of(cls, source: FrameSource, bundle: Bundle, summary: Summary, part: Callable[[int], TracePart]) -> "Traces":
        """Return the traces of a recording whose parts can be had, such as from files."""
        template = sample_cores(torch.zeros(1, *source.shape[1:]), bundle, source.acquisition)
        template = replace(template, values=template.values[:0], weights=template.weights[:0])
        return cls(template=template, summary=summary, part=part)

    def __len__(self) -> int:
        return len(self.summary.contrast)

    def samples(self, numbers: Sequence[int] | NDArray[np.int64]) -> Samples:
        """Return the samples of some frames."""
        places = [divmod(int(number), PART) for number in numbers]
        return replace(
            self.template,
            values=torch.stack([self.part(part).values[row] for part, row in places]),
            weights=torch.stack([self.part(part).weights[row] for part, row in places]),
        )


def count_parts(source: FrameSource) -> int:
    """Return how many parts a recording has."""
    return -(-len(source) // PART)


def trace_unit(work: Work, stage: str, number: int) -> None:
    """Sample one part of the recording."""
    trace_part(work.source, work.bundle, number).save(work.path(stage, number))


def tracing(work: Work, client: Any | None) -> Generator[Doing, None, Traces]:
    """Sample the whole recording, a part at a time; yields how far that is."""
    work.begin(TRACES)
    units = range(count_parts(work.source))
    for _, left in complete(trace_unit, TRACES, work, units, client):
        yield Doing("reading frames", left=left, units=len(units))
    if not work.shared(TRACES).exists():
        Summary.of(_parts_of(work), len(units)).save(work.shared(TRACES))
    return traced(work)


@lru_cache(maxsize=2)
def traced(work: Work) -> Traces:
    """Return the traces that units have left; in one process they share what is in memory."""
    return Traces.of(work.source, work.bundle, Summary.load(work.shared(TRACES)), _parts_of(work))


def _parts_of(work: Work) -> Callable[[int], TracePart]:
    return lru_cache(maxsize=KEPT_PARTS)(lambda number: TracePart.load(work.path(TRACES, number)))
