"""What a burst looks like at a glance: whether there is a bundle, whether it moves, and what speaks against it.

A few frames and the middle of each are enough for that, in a fraction of a second; nothing of it goes into a
reconstruction, which measures all of it anew.
"""

from dataclasses import dataclass

import numpy as np
import torch

from napari_fiberburst.bundle.calibrate import calibrate
from napari_fiberburst.bundle.samples import SATURATED, Samples, exposed, in_grey, sample_cores
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.motion.coarse import LEAST_CONFIDENCE, find_shifts

# So many frames at most are looked at, of so many at the beginning; and so many pixels a side of each.
_FRAMES, _AMONG, _SIDE = 8, 50, 320
# In pitches, from the first frame to the farthest: less does not fill the gaps between cores.
_LEAST_TRAVEL = 0.5
# Cores that are darker than this part of their mean tell nothing.
_DARKEST = 0.02
# Shares of pixels that are as bright as the camera can tell, and of frames that are unlike the others.
_MOST_SATURATED, _MOST_UNLIKE = 0.01, 0.25
# Frames that change by less than this part from one to the other differ by noise, and not by what they show.
_LEAST_CHANGE = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Glance:
    """What a few frames of a burst show.

    Attributes
    ----------
    frames : int
        How many were looked at.
    pitch : float or None
        Distance of neighbouring cores, pixels; None where no bundle is seen.
    travel : float
        How far the object goes from where it is first seen, pixels; NaN for a single frame.
    blank, unlike : int
        Frames that are black, over-exposed or even; and others that could not be found in the rest.
    saturated : float
        Share of the pixels of all others that are too bright for the camera.
    """

    frames: int
    pitch: float | None
    travel: float
    blank: int
    unlike: int
    saturated: float

    @property
    def words(self) -> str:
        """What is seen, in a few words."""
        bundle = "no bundle seen" if self.pitch is None else f"cores {self.pitch:.1f} px apart"
        if not np.isfinite(self.travel):
            return bundle
        way = f"{self.travel:.1f} px" if self.pitch is None else f"{self.travel / self.pitch:.1f} cores"
        return f"{bundle} · moves by {way}"

    @property
    def warnings(self) -> tuple[str, ...]:
        """What speaks against the burst, and what would help, in sentences; empty where nothing does."""
        said = []
        if self.pitch is None:
            said.append(
                "No bundle is seen, so the frames are taken as plain images; if they show one, focus on its cores."
            )
        if self.frames > 1 and self.unlike > _MOST_UNLIKE * self.frames:
            said.append(f"{self.unlike} of {self.frames} frames show something else than the others; take fewer.")
        elif self.pitch is not None and self.travel < _LEAST_TRAVEL * self.pitch:
            said.append(
                f"The object moves by {self.travel:.1f} px only, so gaps between cores stay; move the probe while it "
                "records."
            )
        if self.blank:
            said.append(f"{self.blank} of {self.frames} frames are black, over-exposed or even; they are left out.")
        if self.saturated > _MOST_SATURATED:
            said.append(f"{self.saturated:.0%} of the pixels are too bright for the camera; expose less.")
        return tuple(said)


def some_of(frames: int, height: int, width: int) -> tuple[list[int], tuple[int, int], tuple[int, int]]:
    """Return which of so many frames to look at, and which rows and columns of them, half-open."""
    rows, columns = ((max(0, (side - _SIDE) // 2), min(side, (side + _SIDE) // 2)) for side in (height, width))
    among = min(frames, _AMONG)
    numbers = np.unique(np.linspace(0, among - 1, min(among, _FRAMES)).round().astype(int))
    return numbers.tolist(), rows, columns


def glance(burst: Burst) -> Glance:
    """Look at a few frames of a burst.

    Parameters
    ----------
    burst : Burst
        Any; a few of its frames, and the middle of them, are looked at.

    Examples
    --------
    >>> from napari_fiberburst.simulation import simulate
    >>> glance(simulate("cat", shape=(96, 110), frames=6, pitch=6.0).burst).words
    'cores 6.0 px apart · moves by 3.3 cores'
    """
    numbers, rows, columns = some_of(*burst.shape[:3])
    seen = burst.crop(rows, columns)
    return _of(Burst(seen.frames[numbers], axes="TYXC") if len(numbers) < len(seen.frames) else seen)


def _of(burst: Burst) -> Glance:
    frames = torch.from_numpy(burst.frames)
    shown = exposed(in_grey(frames))
    frames = frames[shown]
    bundle = calibrate(burst, device="cpu")
    travel, unlike = _travel(sample_cores(frames, bundle, burst)) if len(frames) > 1 else (float("nan"), 0)
    return Glance(
        frames=len(burst.frames),
        pitch=None if bundle.pattern == "none" else bundle.pitch,
        travel=travel,
        blank=int((~shown).sum()),
        unlike=unlike,
        saturated=float((frames >= SATURATED).any(dim=-1).float().mean()),
    )


def _travel(samples: Samples) -> tuple[float, int]:
    """Return how far the object goes, pixels, and how many frames could not be found in the others."""
    # Relative to their mean, cores differ by the object alone: their gains, which do not move, are in it.
    mean = samples.mean_light
    relative = samples.grey / mean.clamp_min(_DARKEST * float(mean.mean()))
    shifts = find_shifts(samples.positions, relative, samples.weights, samples.shape, samples.pitch)
    tied = shifts.connected & (shifts.confidence >= LEAST_CONFIDENCE)
    if tied.sum() < 2 and float(relative.std(dim=0).median()) < _LEAST_CHANGE:
        return 0.0, 0
    way = shifts.shifts[tied] - shifts.shifts[tied][:1]
    return float(np.hypot(way[:, 0], way[:, 1]).max(initial=0.0)), int((~tied).sum())
