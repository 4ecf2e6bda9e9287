"""The steps of the method as one flow of values: calibrate, sample, register, refine, flatten, solve.

Every function here is a generator that yields what is known so far and returns its last value, so that whoever drains
it can stop between any two steps and still have something to draw.
"""

import logging
import math
from collections.abc import Generator
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.calibrate import calibrating, plain_frames, remark, shows_the_object, with_even_gains
from napari_fiberburst.bundle.field import dark_places, find_marks, widened
from napari_fiberburst.bundle.mount import Mount, find_mount
from napari_fiberburst.bundle.noise import Noise, measure_noise
from napari_fiberburst.bundle.placement import find_bundle
from napari_fiberburst.bundle.samples import (
    Samples,
    in_grey,
    lit_pixels,
    only_exposed,
    sample_cores,
    sample_pixels,
    shows_detail,
)
from napari_fiberburst.data.burst import Acquisition, Burst
from napari_fiberburst.errors import BurstError
from napari_fiberburst.memory import MemoryLimit
from napari_fiberburst.motion.places import places_with_gains, split_by_place, with_common_gains, with_gains_by_place
from napari_fiberburst.motion.register import refining, registering
from napari_fiberburst.motion.registration import Registration, unregistered
from napari_fiberburst.motion.trust import MOST_UNEXPLAINED
from napari_fiberburst.pipeline.fitted import Fitted
from napari_fiberburst.pipeline.remeasure import lit, remeasured
from napari_fiberburst.pipeline.repeated import find_repeated
from napari_fiberburst.pipeline.scenes import Scenes
from napari_fiberburst.scene.offsets import find_offsets
from napari_fiberburst.scene.outliers import find_outliers
from napari_fiberburst.scene.shading import find_shading, shading_of_frames
from napari_fiberburst.scene.solve import prediction_error
from napari_fiberburst.settings import SplineMethod

logger = logging.getLogger(__name__)

# In pitches: where an object travels less (root mean square), registration starts from two places.
_SHORT_TRAVEL = 0.7
# Two starts are told apart by the error of a tenth of so many samples; of fewer, drawn anew at most so often.
_ENOUGH_SAMPLES, _MOST_DRAWS = 40_000, 8
# Corrections of given gains (root mean square) that are worth a note, and that no bundle needs that was measured well.
_LARGE_CORRECTION, _ANOTHER_BUNDLE = 0.03, 0.12
# Refining by pixels takes long and shows more than cores did: there is an image after so many rounds.
_SKETCHED_AFTER = 3
# Part of a normal distribution that lies within one standard deviation.
_WITHIN_ONE_SIGMA = 0.683


class Stages:
    """The steps for one burst.

    Parameters
    ----------
    burst : Burst
        The frames.
    method : SplineMethod
        How.
    device : torch.device
        Where.
    seed : int
        Of the samples that the first rounds use, and of those that are left out.
    given : Bundle, optional
        The bundle, where it is known.

    Raises
    ------
    BurstError
        There is a single frame, and no bundle.
    """

    def __init__(
        self,
        burst: Burst,
        method: SplineMethod,
        device: torch.device,
        *,
        seed: int = 0,
        given: Bundle | None = None,
        limit: MemoryLimit | None = None,
    ) -> None:
        if burst.shape[0] < 2 and given is None:
            raise BurstError(
                "one frame is a burst only where its bundle is known, because nothing in it tells bundle and object "
                "apart; give a bundle (Bundle.from_image, or reconstruct(burst).bundle), or open at least 2 frames as "
                "one (time, height, width) stack"
            )
        self._burst, self._method, self._seed, self._given, self._limit = burst, method, seed, given, limit
        self._scenes = Scenes(burst.acquisition, method, seed)
        self._copies = find_repeated(burst)
        self._recorded = _without(self._copies, burst).to(device)
        self._frames = self._recorded
        self._grey = in_grey(self._frames)
        self._marks = find_marks(only_exposed(self._grey))
        self._taken: tuple[Bundle, dict[int, Samples]] | None = None

    def align(self) -> Generator[Fitted | None, None, Fitted]:
        """Calibrate and register; None until the bundle is known."""
        mount = find_mount(self._grey)
        fitted = yield from self._align_by(mount)
        reference = fitted.registration.reference
        if mount is not None and mount.offsets[reference].any():
            # The image is in the pixels of the reference frame, so that is where the bundle has to rest.
            fitted = yield from self._align_by(mount.relative_to(reference))
        fitted = yield from self._refine(fitted)
        before = fitted.bundle
        fitted = self._without_offsets(fitted)
        if self._method.flatten == "motion":
            fitted = self._flattened(fitted)
            yield fitted
        if len(self._copies):
            fitted = replace(fitted, registration=fitted.registration.with_copies(self._copies))
        return fitted if self._given is None else _compared(fitted, before)

    def _align_by(self, mount: Mount | None) -> Generator[Fitted | None, None, Fitted]:
        """Calibrate and register frames in which the bundle is brought to rest."""
        steadied: tuple[str, ...] = ()
        if mount is not None:
            self._frames = mount.steadied(self._recorded)
            self._grey = in_grey(self._frames)
            self._taken = None
            steadied = (_warned(mount.note),)
        yield None
        by_mean, notes = yield from self._calibrate(mount)
        is_even = shows_the_object(by_mean, self._grey, self._burst)
        bundle = with_even_gains(by_mean) if is_even else by_mean
        samples = _seen(self._cores(bundle, self._grey[..., None]), mount)
        fitted = Fitted(
            bundle=bundle,
            registration=unregistered(samples),
            canvas=self._scenes.frame_canvas,
            mount=mount,
            notes=(*steadied, *notes),
            dark=dark_places(self._grey, bundle, self._burst),
        )
        fitted = self._glimpsed(fitted, samples)
        yield fitted
        fitted = replace(fitted, noise=self._noise(bundle, samples, mount))
        fitted = yield from self._register(fitted, samples)
        if not self._is_start_in_doubt(fitted, is_even):
            return fitted
        return (yield from self._better_of(fitted, by_mean if is_even else with_even_gains(by_mean)))

    def _noise(self, bundle: Bundle, samples: Samples, mount: Mount | None) -> Noise | None:
        """Measure the camera's noise in frames that are as they were recorded."""
        if mount is None:
            return measure_noise(self._grey, bundle, self._burst, samples)
        exact = torch.from_numpy(mount.exact).to(self._grey.device)
        recorded = replace(samples, values=samples.values[exact], weights=samples.weights[exact])
        return measure_noise(self._grey[exact], bundle, self._burst, recorded)

    def solve(self, fitted: Fitted) -> Generator[Fitted, None, Fitted]:
        """Solve the scene for the bundle and motion as they are."""
        return (yield from self._scenes.solve(replace(fitted, samples=self._in_colour(fitted))))

    def round_off(self, fitted: Fitted | None) -> Fitted:
        """Make bundle, samples, motion and image belong together, wherever the steps have ended."""
        if fitted is None:
            bundle = plain_frames(self._burst.shape[1:3], self._burst)
            samples = self._cores(bundle, self._grey[..., None])
            text = "the run ended before the bundle was calibrated"
            fitted = Fitted(
                bundle=bundle,
                registration=unregistered(samples),
                canvas=self._scenes.frame_canvas,
                notes=(_warned(text),),
            )
        elif fitted.registration.stage != "complete":
            text = "the run ended before the frames were registered"
            fitted = replace(fitted, notes=(*fitted.notes, _warned(text)))
        fitted = self._scenes.without_left_out(fitted)
        return self._sketched(replace(fitted, samples=self._in_colour(fitted)))

    def _calibrate(self, mount: Mount | None) -> Generator[None, None, tuple[Bundle, tuple[str, ...]]]:
        # Marks rest in the frames as recorded, so they move about a bundle that was brought to rest.
        marks = self._marks if mount is None else widened(self._marks, float(np.abs(mount.offsets).max()))
        if self._given is None:
            steps = calibrating(self._grey, self._burst, marks)
            while True:
                try:
                    next(steps)
                    yield
                except StopIteration as end:
                    bundle: Bundle = end.value
                    break
        else:
            placement = find_bundle(self._given.fitted_to(self._burst), self._grey, self._burst)
            yield
            bundle = placement.bundle.masked(marks.cpu().numpy())
            if placement.note:
                return bundle, (_warned(placement.note),)
        bundle = self._flattened_by_frames(bundle)
        text = remark(bundle)
        return bundle, (_warned(text),) if text else ()

    def _register(self, fitted: Fitted, samples: Samples) -> Generator[Fitted, None, Fitted]:
        """Find the motion by whole cores, with an image on the way and at the end."""
        steps = registering(
            samples,
            dof=self._method.motion.dof,
            bends=self._method.motion.bends,
            noise=_typical_noise(fitted, self._burst, samples),
            iterations=self._method.iterations,
            seed=self._seed,
            places=None if fitted.mount is None else fitted.mount.places,
        )
        while True:
            try:
                registration = next(steps)
            except StopIteration as end:
                fitted = replace(fitted, registration=end.value)
                break
            is_rough = registration.stage == "fine" and fitted.registration.stage != "fine"
            fitted = replace(fitted, registration=registration)
            if is_rough:
                fitted = self._sketched(fitted)
            yield fitted
        if fitted.registration.is_still and self._given is None:
            fitted = self._with_equal_cores(fitted)
        fitted = self._sketched(fitted)
        yield fitted
        return fitted

    def _is_start_in_doubt(self, fitted: Fitted, is_even: bool) -> bool:
        """Whether gains and object may have been taken for one another.

        The object hardly moves, or is not explained; or cores have started as equal, and what differs between them has
        passed for an object that stands still.
        """
        bundle, found = fitted.bundle, fitted.registration
        most = self._method.iterations
        is_spent = most is not None and found.iterations >= most
        if not bundle.is_resolved or bundle.gains_known or found.is_still or is_spent:
            return False
        return is_even or found.travel < _SHORT_TRAVEL * bundle.pitch or found.unexplained > MOST_UNEXPLAINED

    def _better_of(self, fitted: Fitted, bundle: Bundle) -> Generator[Fitted, None, Fitted]:
        """Register once more from other gains, and keep that start whose samples predict one another better."""
        samples = _seen(self._cores(bundle, self._grey[..., None]), fitted.mount)
        again = replace(fitted, bundle=bundle, registration=unregistered(samples), scene=None, image=None)
        steps = self._register(again, samples)
        while True:
            try:
                next(steps)
                yield fitted  # whoever stops now gets the first start, which is complete
            except StopIteration as end:
                again = end.value
                return again if self._error(again) < self._error(fitted) else fitted

    def _error(self, fitted: Fitted) -> float:
        """Return by how much samples that are left out are missed, relative to their mean light."""
        samples = _seen(self._cores(fitted.bundle, self._grey[..., None]), fitted.mount)
        grid = self._scenes.coarse_grid(fitted)
        # A tenth of few samples tells little, so several tenths are left out in turn.
        draws = min(max(1, _ENOUGH_SAMPLES // int((samples.weights > 0).sum())), _MOST_DRAWS)
        seeds = range(self._seed, self._seed + draws)
        errors = [prediction_error(samples, fitted.registration, grid, seed=seed) for seed in seeds]
        return float(np.sqrt(np.mean(np.square(errors))))

    def _with_equal_cores(self, fitted: Fitted) -> Fitted:
        """Take all cores as equal: without motion a core's gain cannot be told from what it sees."""
        bundle = fitted.bundle
        if bundle.is_resolved and not bundle.gains_known and fitted.registration.used.sum() > 1:
            text = "the object moves too little to fill the gaps between cores; cores are taken as equally bright"
            fitted = replace(fitted, notes=(*fitted.notes, _warned(text)))
        return replace(fitted, bundle=self._flattened_by_frames(with_even_gains(bundle)))

    def _flattened_by_frames(self, bundle: Bundle) -> Bundle:
        """Take the slow changes of the mean frame into a bundle of unknown gains, where that is asked for."""
        if self._method.flatten != "frame" or bundle.gains_known:
            return bundle
        return lit(bundle, shading_of_frames(self._cores(bundle, self._frames)))

    def _without_offsets(self, fitted: Fitted) -> Fitted:
        """Take the light that cores show by themselves into the bundle, and out of the samples."""
        assert fitted.samples is not None
        offsets = find_offsets(fitted.samples, fitted.registration)
        if offsets is None:
            return fitted
        samples, registration = offsets.without(fitted.samples, fitted.registration)
        bundle = offsets.added_to(fitted.bundle, fitted.registration, self._burst.acquisition)
        return replace(fitted, samples=samples, registration=registration, bundle=bundle)

    def _flattened(self, fitted: Fitted) -> Fitted:
        """Take the shading that the motion tells into bundle, samples and exposures."""
        assert fitted.samples is not None
        samples, registration = fitted.samples, fitted.registration
        cores = samples
        if samples.kind != "cores":
            cores = _seen(self._cores(fitted.bundle, self._frames), fitted.mount)
        shading = find_shading(cores, registration)
        if shading is None:
            return fitted
        return replace(
            fitted,
            bundle=lit(fitted.bundle, shading),
            samples=samples.without_gains(shading.gains),
            registration=shading.exposed(registration),
        )

    def _refine(self, fitted: Fitted) -> Generator[Fitted, None, Fitted]:
        """Measure the transmission anew, decide between cores and pixels, and refine motion and gains by those."""
        outliers = self._outliers(fitted)
        bundle, registration = remeasured(fitted.bundle, fitted.registration, self._grey, self._burst)
        kind = self._kind(bundle, registration)
        if kind == "pixels" and not self._has_room_for_pixels(bundle):
            kind = "cores"
            text = "memory does not allow for the detail that frames show inside cores: one value a core was taken"
            fitted = replace(fitted, notes=(*fitted.notes, _warned(text)))
        if kind == "pixels":
            samples = sample_pixels(self._frames, bundle, self._burst)
        else:
            samples = self._cores(bundle, self._frames)
        samples = _seen(samples, fitted.mount)
        if outliers is not None:
            samples = replace(samples, weights=samples.weights * ~outliers[:, samples.core_index])
        fitted = replace(fitted, bundle=bundle, registration=registration, samples=samples, outliers=outliers)
        steps = self._refining(samples, registration, fitted.mount)
        rounds = 0
        while True:
            try:
                registration, samples = next(steps)
                rounds += 1
                fitted = replace(fitted, registration=registration, samples=samples)
                if kind == "pixels" and rounds == _SKETCHED_AFTER:
                    fitted = self._sketched(fitted)
                yield fitted
            except StopIteration as end:
                registration, samples = end.value
                return replace(fitted, registration=registration, samples=samples)

    def _refining(
        self, samples: Samples, registration: Registration, mount: Mount | None
    ) -> Generator[tuple[Registration, Samples], None, tuple[Registration, Samples]]:
        """Refine motion and gains; of a bundle that moves on the camera, the gains in each of its places."""
        places = None if mount is None else mount.places
        own = None if places is None or samples.kind != "cores" else places_with_gains(places)
        steps = refining(
            samples if own is None else split_by_place(samples, own),
            registration if own is None else with_gains_by_place(registration, own),
            dof=self._method.motion.dof,
            iterations=self._method.iterations,
            seed=self._seed,
            places=places,
        )
        while True:
            try:
                found = next(steps)
                yield (found, samples) if own is None else with_common_gains(found, samples, own)
            except StopIteration as end:
                return (end.value, samples) if own is None else with_common_gains(end.value, samples, own)

    def _outliers(self, fitted: Fitted) -> Tensor | None:
        """Return which cores show something else in which frames, (T, N), so far as that is clear; None if none do."""
        registration, scene = fitted.registration, fitted.registration.scene
        if registration.is_still or scene is None:
            return None
        samples = _seen(self._cores(fitted.bundle, self._grey[..., None]), fitted.mount)
        points = registration.motion.apply(samples.positions)
        outliers = find_outliers(registration.correct(samples), points, scene.grid, scene.light * scene.nodes[None])
        return outliers if bool(outliers.any()) else None

    def _kind(self, bundle: Bundle, registration: Registration) -> str:
        """Return whether cores or pixels are the samples: as asked for, or as the burst itself shows."""
        if self._method.samples != "auto":
            return self._method.samples
        if not bundle.is_resolved:
            return "pixels"
        if registration.is_still:
            return "cores"
        cores = self._cores(bundle, self._grey[..., None]).weighted(torch.from_numpy(registration.used))
        return "pixels" if shows_detail(self._grey, bundle, self._burst, cores, registration.predicted) else "cores"

    def _has_room_for_pixels(self, bundle: Bundle) -> bool:
        """Whether pixels can be the samples; where nothing else can, that is an error."""
        if self._limit is None:
            return True
        lit = int(lit_pixels(bundle).sum())
        if self._method.samples == "pixels" or not bundle.is_resolved:
            self._limit.parts("pixels", lit)
        return self._limit.allows("pixels", lit)

    def _cores(self, bundle: Bundle, frames: Tensor) -> Samples:
        """Return the samples of whole cores of all frames, in colour or grey; those of the last bundle are kept."""
        if self._limit is not None and bundle.is_resolved:
            self._limit.parts("cores", len(bundle.centres))
        if self._taken is None or self._taken[0] is not bundle:
            self._taken = bundle, {}
        kept, channels = self._taken[1], frames.shape[-1]
        if channels not in kept:
            kept[channels] = sample_cores(frames, bundle, self._burst)
        return kept[channels]

    def _in_colour(self, fitted: Fitted) -> Samples:
        """Return the final samples; before they are known, those of whole cores."""
        if fitted.samples is not None:
            return fitted.samples
        return _seen(self._cores(fitted.bundle, self._frames), fitted.mount)

    def _glimpsed(self, fitted: Fitted, samples: Samples) -> Fitted:
        """Fill the gaps between the cores of the first frame that shows something.

        Before the frames are registered to a part of a pitch, all of them together show less than one of them does.
        """
        number = int(np.argmax((samples.weights > 0).any(dim=1).cpu().numpy()))
        chosen = slice(number, number + 1)
        shown = sample_cores(self._frames[chosen], fitted.bundle, self._burst)
        shown = replace(shown, weights=samples.weights[chosen])
        return self._scenes.sketched(fitted, shown, unregistered(shown))

    def _sketched(self, fitted: Fitted) -> Fitted:
        """Solve a coarse image of all that is known so far."""
        samples = self._in_colour(fitted)
        fitted = replace(fitted, canvas=self._scenes.canvas(fitted.registration, samples))
        return self._scenes.sketched(fitted, samples, fitted.registration)


def _compared(fitted: Fitted, given: Bundle) -> Fitted:
    """Note how far the burst has corrected the gains of a bundle that was given, where that is far."""
    assert fitted.samples is not None
    power = torch.zeros(fitted.samples.cores).to(fitted.samples.weights)
    power.index_add_(0, fitted.samples.core_index, fitted.samples.weights.sum(dim=0))
    before, after = given.brightness, fitted.bundle.brightness * fitted.registration.gains
    known = (power.cpu().numpy() > 0) & (before > 0) & (after > 0)
    if not known.any():
        return fitted
    change = after[known] / before[known]
    change = change / np.median(change) - 1
    # Of a normal distribution the root mean square; a few cores at the rim do not decide.
    size = float(np.quantile(np.abs(change), _WITHIN_ONE_SIGMA))
    if size < _LARGE_CORRECTION:
        return fitted
    text = f"the burst has corrected the gains of the given bundle by {100 * size:.0f} % (rms)"
    if size > _ANOTHER_BUNDLE:
        text += ", as if it were of another bundle or in other light; calibrate it again"
    return replace(fitted, notes=(*fitted.notes, _warned(text)))


def _typical_noise(fitted: Fitted, acquisition: Acquisition, samples: Samples) -> float:
    """Return the standard deviation that noise gives to a typical grey sample, full scale 1; 0 where unknown."""
    if fitted.noise is None:
        return 0.0
    variance = fitted.noise.of_samples(fitted.bundle, acquisition, samples)
    return math.sqrt(float(variance[samples.weights > 0].median()))


def _seen(samples: Samples, mount: Mount | None) -> Samples:
    return samples if mount is None else mount.seen(samples)


def _warned(text: str) -> str:
    logger.warning(text)
    return text


def _without(copies: NDArray[np.int64], burst: Burst) -> Tensor:
    """Return the frames (T, H, W, C), black where they repeat another one, so that they count as those do."""
    frames = torch.from_numpy(burst.frames)
    if len(copies):
        frames = frames.clone()
        frames[torch.from_numpy(copies[:, 0])] = 0
    return frames
