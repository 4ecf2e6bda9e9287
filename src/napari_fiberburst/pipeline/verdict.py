"""Whether an image can be trusted: what the burst itself says against the model that the image rests on.

Every criterion holds what the model leaves unexplained against what noise and an honest fit leave. Errors are parts of
how much the object changes in the samples as it moves, because the bundle's own pattern, a dark rim or burned-in marks
are contrast that any image explains. The limits are those that tell simulated bursts which lose more than 3 dB by a
fault from bursts without one (`benchmarks/verdicts.py`).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.operators import steady
from napari_fiberburst.results.diagnostics import Quality
from napari_fiberburst.scene.halves import disagreement
from napari_fiberburst.scene.prediction import predict
from napari_fiberburst.scene.solve import Scene

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
# Cores' gains are not known better than to this part, so errors of this part of the light are to be expected.
_GAIN_ERROR = 0.01
# Below this part of the error that is allowed, signs of single faults do not matter.
_SMALL_ERROR = 0.5
# Ratio of the residuals of blurred frames to those of sharp ones, upper to lower quartile, less 1; it grows as frames
# get fewer, as above.
_UNEVEN_FRAMES = 0.7
# Ratio of the residuals of the worst cores, one in a hundred, to those of a typical one. Where frames are few, single
# edges stand out in it, so it grows with the square of the above.
_UNEVEN_CORES, _WORST = 9.0, 0.99
# From this ratio on single cores make most of the error: their gains are off, or they lie at an edge.
_SINGLE_CORES = 6.0
# Correlation of residuals of neighbouring cores: what differs from the model over several cores makes it high. Frames
# that are blurred in different directions make it negative, because an edge is then too bright on one side and too
# dark on the other.
_STRUCTURE, _BLURRED = 0.12, -0.05
# Power of what stands still in the residuals, 1 for noise.
_STILL_PATTERN = 2.2
# In pitches, root mean square: an object that travels less has not told its cores' gains from its light.
_SHORT_TRAVEL = 0.4
# In pitches, root mean square: frames that moved farther while they were exposed show no more of what lies along it.
_LONG_SMEAR = 0.6
# Frames that take part, at least; and as a part of those that show anything: where more than a quarter differ from the
# rest, the rest is not to be trusted either.
_FEW_FRAMES, _LEAST_USED = 4, 0.72
# Ratio of the light in the middle of the frame to that at its longer side's edge: bursts in even light have 0.8 to 1.4.
_FALLING_OFF = 1.6
# Places that show less than this part of the mean light do not count in it.
_DARK = 0.02
# In pitches, or pixels where these are the samples, the distance within which samples are neighbours; so many pairs of
# them are enough.
_NEIGHBOURS, _PAIRS = 1.4, 30_000
# Frames that a core is seen in, at least, where its residuals are held against one another.
_LEAST_FRAMES = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GoodnessOfFit:
    """What a verdict is made of; NaN where it is not known.

    Attributes
    ----------
    error : float
        Root mean square error of samples left out of the fit, as a part of how much the object changes in samples as
        it moves, both without the noise.
    disagreement : float
        Half the difference of the scenes that two halves of the burst show, in the same parts.
    misfit : float
        Root mean square of the residuals in standard deviations of the noise: 1 for a perfect model (the root of the
        reduced chi-square).
    frame_misfit : tuple of float
        The same for every frame.
    core_misfit : numpy.ndarray
        (N,) float32, the same for every sample's place: every core, or every pixel where these are the samples.
    structure : float
        Correlation of the residuals of neighbouring samples, what all frames have alike left out: 0 for noise.
    still : float
        Power of what the residuals of a place have alike in all frames, over what noise as strong as their changes
        would leave there: 1 for noise, less where gains were fitted.
    smear : float
        How far the frames moved while they were exposed, pixels (root mean square); 0 where that is not seen.
    falloff : float
        How much brighter the middle of the frame is than the edge of its longer side, as a ratio, once all that is
        known of bundle and illumination is taken out.
    is_noise_known : bool
        Whether the noise was measured. Otherwise misfits are relative to 1 at full scale, and noise is what
        neighbouring samples do not share.
    """

    error: float
    disagreement: float
    misfit: float
    frame_misfit: tuple[float, ...]
    core_misfit: NDArray[np.float32]
    structure: float
    still: float
    smear: float
    falloff: float
    is_noise_known: bool

    def is_smeared_far(self, pitch: float) -> bool:
        """Whether frames moved so far while they were exposed that detail is lost."""
        return self.smear > _LONG_SMEAR * pitch

    @property
    def unevenness(self) -> float:
        """Upper over lower quartile of the frames' misfit."""
        known = [misfit for misfit in self.frame_misfit if np.isfinite(misfit) and misfit > 0]
        if len(known) < 4:
            return float("nan")
        low, high = np.quantile(known, [0.25, 0.75])
        return float(high / low)

    @property
    def peak(self) -> float:
        """Misfit of the worst cores over that of a typical one."""
        known = self.core_misfit[np.isfinite(self.core_misfit)]
        typical = float(np.median(known)) if len(known) else 0.0
        return float(np.quantile(known, _WORST)) / typical if typical > 0 else float("nan")


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Residuals:
    """What a scene leaves of samples in grey.

    Attributes
    ----------
    off : Tensor
        (T, N), 0 where there is no sample.
    known : Tensor
        (T, N) bool.
    """

    off: Tensor
    known: Tensor

    @property
    def still(self) -> Tensor:
        """What all frames have alike, (N,)."""
        return self.off.sum(dim=0) / self.known.sum(dim=0).clamp_min(1)

    @property
    def changing(self) -> Tensor:
        """The rest, (T, N)."""
        return torch.where(self.known, self.off - self.still, 0.0)


def collect(scene: Scene, registration: Registration, variance: Tensor | None) -> GoodnessOfFit:
    """Return what the samples say of the scene that was solved from them.

    Parameters
    ----------
    scene, registration
        Of the burst.
    variance : Tensor or None
        (T, N) of the noise of one channel of `scene.samples`, full scale 1; None where it is not known.
    """
    samples = scene.samples
    channels = samples.values.shape[2]
    points = registration.points(samples.positions)
    left = _residuals(scene, scene.looks(points))
    shared, structure = _neighbours(left, samples)
    mass = samples.weights * left.known
    if variance is None:
        alone = _mean(mass, left.changing.square()) - max(shared, 0.0)
        noise = channels * max(alone, 0.0)
    else:
        noise = _mean(mass, variance)
    changed = _change(replace(samples, weights=mass)) - noise / channels
    change = changed**0.5 if changed > 0 else float("nan")  # the noise hides all that the object does
    expected = noise + _GAIN_ERROR**2 * _mean(mass, samples.grey.square())
    error = float("nan") if scene.held_out_rmse is None else max(scene.held_out_rmse**2 - expected, 0.0) ** 0.5
    scaled = left.off.square() * (1.0 if variance is None else channels / variance.clamp_min(1e-12))
    of_frames, of_cores = (_root_mean(scaled, left.known, over=axis) for axis in (1, 0))
    halves = float("nan")
    if not registration.is_still:
        halves = disagreement(samples, points, np.flatnonzero(registration.used))
    return GoodnessOfFit(
        error=error / change,
        disagreement=halves / change,
        misfit=float("nan") if variance is None else float(steady.mean(scaled[left.known]).sqrt()),
        frame_misfit=tuple(of_frames.tolist()),
        core_misfit=of_cores.cpu().numpy().astype(np.float32),
        structure=structure,
        still=_still_power(left),
        smear=0.0 if scene.smear is None else scene.smear.length,
        falloff=_falloff(samples),
        is_noise_known=variance is not None,
    )


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
    is_of_single_cores = fit.disagreement <= _AGREEMENT * gaps and fit.peak > _SINGLE_CORES
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
    if fit.still > _STILL_PATTERN:
        reasons.append(
            "a pattern that stands still in all frames is not explained: a bundle that was not found, light of the "
            "bundle itself, or an object that was held for one"
        )
    if fit.is_noise_known and fit.structure > _STRUCTURE and is_material:
        reasons.append(
            "what the image leaves unexplained is alike in neighbouring cores, so something else than noise is in it"
        )
    if fit.is_smeared_far(pitch):
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


def _residuals(scene: Scene, points: Tensor) -> _Residuals:
    samples = scene.samples
    off = torch.zeros_like(samples.weights)
    known = torch.zeros_like(samples.weights, dtype=torch.bool)
    for frame, values, light, weights in predict(samples, points, scene.grid, scene.filtered):
        known[frame] = weights > 0
        off[frame] = torch.where(known[frame], (values - light).mean(dim=1), 0.0)
    return _Residuals(off=off, known=known)


def _mean(mass: Tensor, values: Tensor) -> float:
    return float(steady.weighted_mean(values, mass))


def _change(samples: Samples) -> float:
    """Return the variance of what samples change from frame to frame, full scale 1."""
    mean = (samples.weights * samples.grey).sum(dim=0) / samples.weights.sum(dim=0).clamp_min(1e-9)
    return _mean(samples.weights, (samples.grey - mean).square())


def _falloff(samples: Samples) -> float:
    """Return how much brighter the middle of the frame is than the edge of its longer side: by a parabola in logs."""
    mass = samples.weights.sum(dim=0)
    light = (samples.weights * samples.grey).sum(dim=0) / mass.clamp_min(1e-9)
    seen = (mass > 0) & (light > _DARK * steady.weighted_mean(light, mass))
    height, width = samples.shape
    middle = torch.tensor([width - 1.0, height - 1.0]).to(light) / 2
    places = 2 * (samples.positions[seen].to(light) - middle) / max(height, width)
    terms = torch.cat([torch.ones_like(places[:, :1]), places, places.square().sum(dim=1, keepdim=True)], dim=1)
    if int(seen.sum()) < 2 * terms.shape[1]:
        return 1.0
    fitted = np.linalg.lstsq(terms.double().cpu().numpy(), light[seen].log().double().cpu().numpy())[0]
    return float(np.exp(-fitted[-1]))


def _root_mean(squares: Tensor, known: Tensor, *, over: int) -> Tensor:
    """Return the root of the mean of squares (T, N) that are known, along an axis; NaN where none is."""
    counts = known.sum(dim=over)
    means = torch.where(known, squares, 0.0).sum(dim=over) / counts.clamp_min(1)
    return torch.where(counts > 0, means.sqrt(), torch.nan)


def _neighbours(left: _Residuals, samples: Samples) -> tuple[float, float]:
    """Return covariance and correlation of what changes in residuals of neighbouring samples; NaN where too few are."""
    reach = _NEIGHBOURS * (samples.pitch if samples.kind == "cores" else 1.0)
    pairs = cKDTree(samples.positions.cpu().numpy()).query_pairs(reach, output_type="ndarray")
    if len(pairs) < 10 or len(left.off) < _LEAST_FRAMES:
        return float("nan"), float("nan")
    first, second = torch.from_numpy(pairs[:: -(-len(pairs) // _PAIRS)].T.copy()).to(left.off.device)
    both = left.known[:, first] & left.known[:, second]
    one, other = (torch.where(both, left.changing[:, part], 0.0).double() for part in (first, second))
    product, power = (
        float(steady.total(one * other)),
        float((steady.total(one.square()) * steady.total(other.square())).sqrt()),
    )
    if power <= 0:
        return float("nan"), float("nan")
    return product / int(both.sum()), product / power


def _still_power(left: _Residuals) -> float:
    """Return how much stronger what stands still in the residuals is than noise would leave it."""
    counts = left.known.sum(dim=0)
    often = counts >= _LEAST_FRAMES
    expected = left.changing.square().sum(dim=0)[often] / (counts[often] - 1)
    total = float(steady.total(expected))
    return float(steady.total((left.still.square() * counts)[often])) / total if total > 0 else float("nan")
