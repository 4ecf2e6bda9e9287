"""Whether an image can be trusted: what the burst itself says against the model that the image rests on.

The limits are those that tell simulated bursts which lose more than 3 dB by a fault from bursts without one
(`benchmarks/verdicts.py`).
"""

from dataclasses import dataclass

import numpy as np

from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.pipeline.goodness import GoodnessOfFit
from napari_fiberburst.results.diagnostics import Quality

# Error of samples that were left out, as a part of what the object changes in them. It grows as frames get fewer than
# the third number, because their samples leave gaps; where samples are pixels there are none.
_DOUBTFUL_ERROR, _BAD_ERROR, _ENOUGH_FRAMES = 0.18, 0.4, 14
# What noise is left in errors of pixels is told from those alone.
_DOUBTFUL_PIXELS = 0.3
# Disagreement of the first half of the frames with the second, in the same parts. Up to the second number the halves
# agree.
_DISAGREEMENT, _AGREEMENT = 0.25, 0.12
# Residuals of at most this many standard deviations of the noise are noise, however little of the object is seen.
_NOISE_ALONE = 1.15
# Below this part of the error that is allowed, signs of single faults do not matter.
_SMALL_ERROR = 0.5
# Ratio of the residuals of blurred frames to those of sharp ones, upper to lower quartile, less 1; it grows as frames
# get fewer, as above.
_UNEVEN_FRAMES = 0.7
# Ratio of the residuals of the worst cores, one in a hundred, to those of a typical one. Where frames are few, single
# edges stand out in it, so it grows with the square of the above.
_UNEVEN_CORES = 9.0
# From this ratio on single cores make most of the error: their gains are off, or they lie at an edge. Not so where the
# typical residual is as many standard deviations of the noise as the second number, or neighbours have it in common.
_SINGLE_CORES, _MISFIT_OF_FEW = 6.0, 6.0
# Correlation of residuals of neighbouring cores: what differs from the model over several cores makes it high. Frames
# that are blurred in different directions make it negative, because an edge is then too bright on one side and too
# dark on the other.
_STRUCTURE, _BLURRED = 0.12, -0.05
# Power of what stands still in the residuals, 1 for noise. What one pattern adds to it grows with the frames that are
# averaged, so beyond so many of them what is too weak to matter would be seen as well. So it would where most of the
# object is dark, because there is hardly any noise: samples left out are then missed by less than the last number, in
# parts as above.
_STILL_PATTERN, _STILL_FRAMES, _HARDLY_ANY_ERROR = 2.2, 20, 0.05
# In pitches, root mean square: an object that travels less has not told its cores' gains from its light.
_SHORT_TRAVEL = 0.4
# In pitches, root mean square: frames that moved farther while they were exposed show no more of what lies along it.
_LONG_SMEAR = 0.6
# Frames that take part, at least; and as a part of those that show anything: where more than a quarter differ from the
# rest, the rest is not to be trusted either.
_FEW_FRAMES, _LEAST_USED = 4, 0.72
# Ratio of the light in the middle of the frame to that at its longer side's edge: bursts in even light have 0.8 to 1.4.
_FALLING_OFF = 1.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Whether to trust an image, and why not.

    Attributes
    ----------
    quality : str
        "good"; "doubtful", where it is worse than such a burst should give; "bad", where it does not show the object.
    reasons : tuple of str
        In plain words; none for a good one.
    """

    quality: Quality
    reasons: tuple[str, ...] = ()


def is_smeared_far(fit: GoodnessOfFit, pitch: float) -> bool:
    """Whether frames moved so far while they were exposed that detail is lost."""
    return fit.smear > _LONG_SMEAR * pitch


def judge(fit: GoodnessOfFit, registration: Registration, pitch: float, *, gains_known: bool) -> Verdict:
    """Return the verdict.

    Parameters
    ----------
    fit : GoodnessOfFit
        By `collect`.
    registration : Registration
        Of the burst.
    pitch : float
        Distance of neighbouring cores, pixels.
    gains_known : bool
        Whether the cores' gains were known before, so that motion need not tell them.
    """
    shows = ~np.isnan(registration.confidence) | registration.used
    shows[list(registration.left_out)] = False
    used, count = int(registration.used.sum()), int(shows.sum())
    reasons: list[str] = []
    is_bad = False
    # A single look at the object has gaps that no sample left out can be predicted across.
    gaps = max(1.0, _ENOUGH_FRAMES / max(1, used))
    # NaN, a misfit that is not known, is no reason to take it for noise.
    is_more_than_noise = not registration.is_still and not fit.misfit <= _NOISE_ALONE
    allowed = _DOUBTFUL_ERROR * gaps if fit.is_noise_known else _DOUBTFUL_PIXELS
    is_common = fit.misfit > _MISFIT_OF_FEW or (fit.is_noise_known and fit.structure > _STRUCTURE)
    is_of_single_cores = fit.disagreement <= _AGREEMENT * gaps and fit.peak > _SINGLE_CORES and not is_common
    is_material = not is_of_single_cores and fit.error > _SMALL_ERROR * allowed
    if is_more_than_noise and not is_of_single_cores and fit.error > allowed:
        is_bad = fit.error > allowed * _BAD_ERROR / _DOUBTFUL_ERROR
        reasons.append(
            f"samples that were left out are missed by {100 * fit.error:.0f} % of what changes in them: the object "
            "moves or changes in other ways than by the motion that was found"
        )
    if is_more_than_noise and fit.disagreement > _DISAGREEMENT * gaps:
        reasons.append(
            "the first half of the frames shows another image than the second half: the object, or how the frames look "
            "at it, has changed"
        )
    is_exact = fit.error <= _HARDLY_ANY_ERROR * gaps
    if fit.still > 1 + (_STILL_PATTERN - 1) * max(1.0, used / _STILL_FRAMES) and not is_exact:
        reasons.append(
            "a pattern that stands still in all frames is not explained: a bundle that was not found, light of the "
            "bundle itself, or an object that was held for one"
        )
    if fit.is_noise_known and fit.structure > _STRUCTURE and is_material:
        reasons.append(
            "what the image leaves unexplained is alike in neighbouring cores, so something else than noise is in it"
        )
    if is_smeared_far(fit, pitch):
        reasons.append(
            f"frames moved by {fit.smear:.1f} px while they were exposed: detail along the motion is lost; a shorter "
            "exposure shows it"
        )
    elif fit.is_noise_known and fit.structure < _BLURRED:
        reasons.append("edges are sharper in some frames than in others: the object moved while frames were exposed")
    if fit.unevenness > 1 + _UNEVEN_FRAMES * gaps and is_material:
        reasons.append("many frames fit much worse than others: they are blurred, or out of focus")
    if fit.is_noise_known and fit.peak > _UNEVEN_CORES * gaps**2 and is_material:
        reasons.append(
            "some cores fit much worse than others, such as those at a rim or under a mark: the image is wrong there"
        )
    if fit.falloff > _FALLING_OFF and not gains_known and not registration.is_still:
        reasons.append(
            f"the middle of the frame is {fit.falloff:.1f} times as bright as its edge, and the motion does not tell "
            'whether that is the light or the object; flatten="frame" takes it out, or an image of the bundle in even '
            "light does"
        )
    if count > 1 and used < max(2, _LEAST_USED * count):
        is_bad = is_bad or used < 2
        reasons.append(f"only {used} of the {count} frames that show anything could be registered")
    is_few = 1 < count and used < _FEW_FRAMES
    if is_few and not gains_known:
        reasons.append(f"{used} frames tell little of the cores' gains; a bundle that is known would tell them")
    elif not gains_known and (registration.is_still or registration.travel < _SHORT_TRAVEL * pitch):
        reasons.append("the object moves too little to tell the cores' gains from its own light")
    quality: Quality = "bad" if is_bad else "doubtful" if reasons else "good"
    return Verdict(quality=quality, reasons=tuple(reasons))
