"""From a burst to aligned samples: calibrate, register, and learn what a sensor is.

Everything that fits a scene behind a bundle, splines and networks, starts from here.
"""

import logging
from collections.abc import Iterator
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.calibrate import Calibration, calibrate, remeasure
from napari_fiberburst.bundle.samples import Observation, observe_cores, observe_pixels, shows_detail
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.motion.checks import contrast, exposed, fitness, travel
from napari_fiberburst.motion.coarse import LEAST_CONFIDENCE, confidence, find_shifts
from napari_fiberburst.motion.joint import COARSE, ENOUGH, FINE_CORES, FINE_PIXELS, FINER, Groupwise, Level
from napari_fiberburst.motion.models import DEGREES_OF_FREEDOM, FrameMotion
from napari_fiberburst.settings import Settings

logger = logging.getLogger(__name__)

# The motion has a handful of unknowns a frame, so this many samples of it are plenty.
_MOST_SAMPLES = 500_000
# And its first rounds, which only bring rotation and perspective into reach, need fewer.
_COARSE_SAMPLES = 60_000
# In pitches: frames that move less do not fill the gaps between cores.
_LEAST_MOTION = 0.25
# The mean of few frames still shows an object of much contrast, and a gain taken from it would hide it: then all cores
# start as equal. In low contrast it is the cores' own gains that would hold the object still.
_FEW_FRAMES, _MUCH_CONTRAST = 8, 0.022
# A frame that agrees with the others less than this part of what is usual is left out.
_LEAST_OF_USUAL = 0.6
# A frame whose transform swells or shrinks by more than this, or leaves by more than its own size, is lost.
_MOST_SWELLING = 3.0


class Alignment:
    """A burst's calibration, motion and samples, in the making.

    Parameters
    ----------
    burst : Burst
        The frames.
    settings : Settings
        Which motion, which observation.
    device : torch.device
        Where.
    image : Tensor, optional
        (H, W, C), the bundle with even light before it.

    Attributes
    ----------
    calibration : Calibration
        Of the bundle.
    observation : Observation
        The samples, gains taken out.
    motion : FrameMotion
        Frame t's pixels to the scene.
    gains : Tensor
        One per core; already taken out of the observation.
    used : numpy.ndarray
        (T,) bool, frames that take part.
    confidence : numpy.ndarray
        (T,), 0 to 1; NaN until it is known.
    is_registered, is_refined : bool
        Whether the motion has been found, and whether the samples are the final ones.
    residual : float
        What the last round left, in parts of the mean light.
    is_still : bool
        Whether the object moves too little to fill the gaps between cores.
    notes : list of str
        What a user should know of this burst.
    """

    def __init__(self, burst: Burst, settings: Settings, device: torch.device, image: Tensor | None = None) -> None:
        self.frames = torch.from_numpy(burst.frames).to(device)
        self._grey = self.frames.mean(dim=3)
        self._settings = settings
        self._image = None if image is None else image.mean(dim=2).to(device)
        self.shape = (burst.shape[1], burst.shape[2])
        count = burst.shape[0]
        self.motion = FrameMotion(count, self.shape)
        self._freedom = DEGREES_OF_FREEDOM.get(settings.motion.name, 8)
        self._stands = settings.motion.name == "none"
        self.used: NDArray[np.bool_] = np.ones(count, dtype=bool)
        self.confidence: NDArray[np.float64] = np.full(count, np.nan)
        self.residual = float("nan")
        self.is_still = False
        self.notes: list[str] = []
        self.calibration: Calibration = calibrate(self._grey[exposed(self._grey)], self._image)
        self._note(self.calibration.remark)
        self.observation: Observation = observe_cores(self._grey[..., None], self.calibration)
        if count <= _FEW_FRAMES and contrast(self.observation.values[..., 0]) > _MUCH_CONTRAST:
            self.calibration = self.calibration.with_even_gains()
            self.observation = observe_cores(self._grey[..., None], self.calibration)
        self.gains = torch.ones(len(self.calibration.centres), device=device)
        self._group: Groupwise | None = None
        self.is_registered = self.is_refined = False
        self._rounds_left = np.inf

    @property
    def pitch(self) -> float:
        """The bundle's pitch, or the side of the blocks that stand for cores, pixels."""
        return self.calibration.pitch

    @property
    def reference(self) -> int:
        """The frame in whose pixels the picture is drawn: the first that takes part."""
        return int(np.flatnonzero(self.used)[0])

    def take(self, scene_from_frame: NDArray[np.float64], kind: Literal["cores", "pixels"]) -> None:
        """Take motion (T, 3, 3) and the kind of sensors as known, instead of finding them; gains stay as they are."""
        self.motion.scene_from_frame = torch.from_numpy(np.array(scene_from_frame, dtype=np.float64))
        self.observation = (observe_pixels if kind == "pixels" else observe_cores)(self.frames, self.calibration)
        self.is_refined = True

    def register(self) -> Iterator[str]:
        """Find the motion by samples of whole cores; yields what was done, after each round."""
        self._rounds_left = self._settings.iterations or np.inf
        if self._stands:
            self._start(np.zeros((len(self.used), 2)), self.confidence, self.used)
            self._judge(self.observation.values[..., 0])
            self._settle_still()
            self.is_registered = True
            return
        seen = self.observation
        values = seen.values[..., 0]
        shifts = find_shifts(seen.positions, values, seen.weights, self.shape, self.pitch)
        self._start(shifts.shifts, shifts.confidence, shifts.connected)
        yield "frames shifted"
        if self.used.sum() > 1:
            yield from self._rounds((COARSE,), self._new_group(_COARSE_SAMPLES), None, "registering")
            yield "roughly registered"
            yield from self._rounds(FINER, self._new_group(None), None, "registering")
            assert self._group is not None
            self._judge(self.observation.values[..., 0] / self._group.gains)
        if self.is_still or self.used.sum() < 2:
            self._settle_still()
        self.is_registered = True

    def refine(self) -> Iterator[str]:
        """Measure the transmission anew, learn what a sensor is, and refine motion and gains with it."""
        self._rounds_left = self._settings.iterations or np.inf
        if not self.is_still:
            self._remeasure()
        kind = self._settings.observation
        if kind == "auto":
            kind = "pixels" if self._pixels_are_sensors() else "cores"
        observe = observe_pixels if kind == "pixels" else observe_cores
        self.observation = self._weighed(observe(self.frames, self.calibration))
        self.is_refined = True
        if not self.is_still:
            yield from self._fine(FINE_PIXELS if kind == "pixels" else FINE_CORES)

    def in_colour(self) -> Observation:
        """Return the samples in all channels: the final ones if they are there, else those of cores as they are."""
        if self.is_refined:
            return self.observation
        seen = self._weighed(observe_cores(self.frames, self.calibration))
        known = self._group is not None and len(self._group.gains) == len(self.calibration.centres)
        return seen.with_gains(self._group.gains) if self._group is not None and known else seen

    def points(self, seen: Observation | None = None) -> Tensor:
        """Return where each sensor is in the reference frame's pixels, (T, N, 2); NaN for frames left out."""
        return self._map((self.observation if seen is None else seen).positions)

    def homographies(self) -> NDArray[np.float64]:
        """Return (T, 3, 3), frame-t pixel to the reference frame's pixel; NaN for frames left out."""
        relative = self.motion.relative_to(self.reference)
        relative[~self.used] = np.nan
        return relative

    def scene_at(self, number: int, pixels: Tensor) -> Tensor:
        """Return the grey scene behind a frame's pixels (N, 2); 0 where nothing is known."""
        if self._group is None or not self.used[number]:
            return torch.zeros(len(pixels)).to(pixels)
        matrix = self.motion.scene_from_frame[number].to(pixels)
        mapped = pixels @ matrix[:, :2].T + matrix[:, 2]
        return self._group.grid.at(mapped[:, :2] / mapped[:, 2:]).read(self._group.scene) * self._light

    def _map(self, pixels: Tensor) -> Tensor:
        matrices = torch.from_numpy(self.homographies()).to(pixels)
        mapped = pixels @ matrices[:, :, :2].mT + matrices[:, None, :, 2]
        return mapped[..., :2] / mapped[..., 2:]

    def _start(self, shifts: NDArray[np.float64], trust: NDArray[np.float64], connected: NDArray[np.bool_]) -> None:
        self.used, self.confidence = connected.copy(), trust
        shifts = shifts - shifts[self.reference]
        shifts[~self.used] = 0
        self.motion.shift(shifts)
        self._shifts = shifts
        self.observation = self._weighed(self.observation)
        mass = self.observation.weights.sum().clamp_min(1e-9)
        self._light = float((self.observation.values[..., 0] * self.observation.weights).sum() / mass)
        self._light = max(self._light, 1e-4)

    def _new_group(self, most: int | None) -> Groupwise:
        """Return a registration of the observation's sensors, or of so many samples of them, from where things are."""
        seen = self.observation
        some = torch.arange(len(seen.positions), device=seen.positions.device)
        if most is not None:
            wanted = max(1, most // int(self.used.sum()))
            generator = torch.Generator().manual_seed(self._settings.seed)
            some = (
                torch.randperm(len(seen.positions), generator=generator)[:wanted]
                .sort()
                .values.to(seen.positions.device)
            )
        group = Groupwise(
            seen.positions[some],
            seen.values[:, some].mean(dim=2) / self._light,
            seen.weights[:, some],
            self.motion,
            self.pitch,
            self._freedom,
            sources=seen.sources[some] if seen.kind == "pixels" else None,
            gains_fixed=self.calibration.is_trusted,
        )
        if self._group is not None:
            group.take_over(self._group)
        return group

    def _rounds(self, levels: tuple[Level, ...], group: Groupwise, radius: float | None, name: str) -> Iterator[str]:
        self._group = group
        for level in levels:
            if self._rounds_left <= 0:
                return
            group.enter(level, radius)
            for number in range(level.rounds):
                before = self.motion.scene_from_frame.clone()
                longest = group.round(level, number)
                self._catch_lost(group, before)
                self.residual = group.residual
                self._rounds_left -= 1
                yield name
                if self._rounds_left <= 0 or (longest < ENOUGH and number > 0):
                    break
            group.settle()

    def _fine(self, levels: tuple[Level, ...]) -> Iterator[str]:
        """Refine on the final sensors, from where the scene is, and take the gains out of the samples."""
        if self._group is None:
            return
        seen = self.observation
        group = self._new_group(_MOST_SAMPLES if seen.kind == "pixels" else None)
        yield from self._rounds(levels, group, seen.radius, "refining")
        self.gains = torch.ones(len(self.calibration.centres)).to(group.gains)
        self.gains[: len(group.gains)] = group.gains
        self.observation = self._weighed(seen.with_gains(self.gains), group)

    def _judge(self, values: Tensor) -> None:
        """Ask how far each frame is to be trusted, leave out those that are not, and see whether they move at all."""
        seen = self.observation
        found = confidence(seen.positions, values, seen.weights, self.motion, self.pitch)
        self.confidence = np.where(self.used, np.clip(found, 0, 1), 0.0)
        usual = np.median(self.confidence[self.used])
        self.used &= self.confidence >= max(LEAST_CONFIDENCE, _LEAST_OF_USUAL * usual)
        self.observation = self._weighed(seen)
        if self.used.sum() < 2:
            return
        if not self.used.all():
            left_out = ", ".join(str(number) for number in np.flatnonzero(~self.used))
            self._note(f"frames that could not be registered are left out: {left_out}")
        self.is_still = travel(self.homographies()[self.used], self.shape) < _LEAST_MOTION * self.pitch

    def _settle_still(self) -> None:
        """Without motion a core's gain cannot be told from what it sees: take all cores as equal."""
        self.is_still = True
        if self.used.sum() < 2:
            self._note("the frames could not be registered to one another; the picture is made of one of them alone")
            # The frame of median brightness is neither black nor over-exposed.
            brightness = self._grey.mean(dim=(1, 2)).cpu().numpy()
            best = int(np.argsort(brightness)[len(brightness) // 2])
            self.used = np.arange(len(self.used)) == best
            self.observation = self._weighed(observe_cores(self._grey[..., None], self.calibration))
        elif self.calibration.is_resolved and not self.calibration.is_trusted:
            self._note("the object moves too little to fill the gaps between cores; cores are taken as equally bright")
        self.calibration = self.calibration.with_even_gains()
        self._light = 1.0

    def _remeasure(self) -> None:
        if self._group is not None and not self.calibration.is_trusted:
            used = torch.from_numpy(self.used)
            numbers = np.flatnonzero(self.used)
            self.calibration = remeasure(
                self.calibration,
                self._grey[used],
                lambda number, pixels: self.scene_at(int(numbers[number]), pixels),
            )

    def _pixels_are_sensors(self) -> bool:
        if not self.calibration.is_resolved:
            return True
        if self.is_still:
            return False
        cores = self._weighed(observe_cores(self._grey[..., None], self.calibration))
        return shows_detail(self._grey, self.calibration, cores, self.scene_at)

    def _weighed(self, seen: Observation, group: Groupwise | None = None) -> Observation:
        """Leave out the samples of unused frames, and let frames that fit badly, blurred ones perhaps, count less."""
        weights = torch.from_numpy(self.used).to(seen.weights)
        return seen.weighted(weights if group is None else weights * fitness(group, self.used))

    def _catch_lost(self, group: Groupwise, before: Tensor) -> None:
        """Leave out frames whose transform has run away, before they tear the scene apart."""
        lost = self.motion.has_left(self._shifts, _MOST_SWELLING)
        if lost.any():
            self.motion.scene_from_frame[torch.from_numpy(lost)] = before[torch.from_numpy(lost)]
            if (self.used & ~lost).any():
                self.used &= ~lost
                group.weights = group.weights * torch.from_numpy(~lost).to(group.weights)[:, None]

    def _note(self, text: str) -> None:
        if text:
            logger.warning(text)
            self.notes.append(text)
