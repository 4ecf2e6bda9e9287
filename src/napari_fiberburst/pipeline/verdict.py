"""Whether an image can be trusted: what the burst itself says against the model that the image rests on.

Every criterion holds what the model leaves unexplained against what noise and an honest fit leave. The limits are those
that tell simulated bursts which lose more than 3 dB by a fault from bursts without one (`benchmarks/verdicts.py`).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.results.diagnostics import Quality
from napari_fiberburst.scene.prediction import predict
from napari_fiberburst.scene.solve import Scene

# Error of samples that were left out, without the noise, as a part of the samples' standard deviation. It is this many
# times as large where the noise is not known, and is in it; and grows as frames get fewer than this, because their
# samples leave gaps.
_DOUBTFUL_ERROR, _BAD_ERROR = 0.11, 0.22
_WITH_NOISE, _ENOUGH_FRAMES = 3.0, 8
# Cores' gains are not known better than to this part, so errors of this part of the light are to be expected.
_GAIN_ERROR = 0.01
# Ratio of the residuals of blurred frames to those of sharp ones: upper to lower quartile.
_UNEVEN_FRAMES = 1.5
# Correlation of residuals of neighbouring cores.
_STRUCTURE = 0.12
# In pitches, root mean square: an object that travels less has not told its cores' gains from its light.
_SHORT_TRAVEL = 0.4
# Frames that take part, at least; and as a part of all.
_FEW_FRAMES, _LEAST_USED = 4, 0.5
# In pitches, the distance within which cores are neighbours.
_NEIGHBOURS = 1.4


@dataclass(frozen=True, slots=True, kw_only=True)
class GoodnessOfFit:
    """What a verdict is made of; NaN where it is not known.

    Attributes
    ----------
    error : float
        Root mean square error of samples left out of the fit, without the noise and what the gains' errors make of the
        light, over the samples' standard deviation.
    misfit : float
        Root mean square of the residuals in standard deviations of the noise: 1 for a perfect model (the root of the
        reduced chi-square).
    frame_misfit : tuple of float
        The same for every frame.
    structure : float
        Correlation of the residuals of neighbouring cores, what all frames have alike left out: 0 for a perfect model.
    """

    error: float
    misfit: float
    frame_misfit: tuple[float, ...]
    structure: float

    @property
    def is_noise_known(self) -> bool:
        """Whether the noise has been taken out of `error`."""
        return bool(np.isfinite(self.misfit))

    @property
    def unevenness(self) -> float:
        """Upper over lower quartile of the frames' misfit."""
        known = [misfit for misfit in self.frame_misfit if np.isfinite(misfit) and misfit > 0]
        if len(known) < 4:
            return float("nan")
        low, high = np.quantile(known, [0.25, 0.75])
        return float(high / low)


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
    points = registration.points(samples.positions)
    off = torch.full_like(samples.weights, torch.nan)
    for frame, values, light, weights in predict(samples, points, scene.grid, scene.filtered):
        off[frame] = torch.where(weights > 0, (values - light).mean(dim=1), torch.nan)
    known = torch.isfinite(off)
    mass = samples.weights * known
    total = mass.sum().clamp_min(1e-9)
    contrast = float(replace(samples, weights=mass).contrast)
    noise = 0.0 if variance is None else float((mass * variance).sum() / total)
    held_out = float("nan") if scene.held_out_rmse is None else scene.held_out_rmse
    expected = noise + float((mass * (_GAIN_ERROR * samples.grey) ** 2).sum() / total)
    error = max(held_out**2 - expected, 0.0) ** 0.5 / max(contrast, 1e-9) if held_out == held_out else held_out
    channels = samples.values.shape[2]
    scaled = off.square() * (1.0 if variance is None else channels / variance.clamp_min(1e-12))
    counts = known.sum(dim=1)
    per_frame = torch.where(known, scaled, 0.0).sum(dim=1) / counts.clamp_min(1)
    return GoodnessOfFit(
        error=error,
        misfit=float("nan") if variance is None else float(scaled[known].mean().sqrt()),
        frame_misfit=tuple(
            float(value) ** 0.5 if count else float("nan") for value, count in zip(per_frame, counts, strict=True)
        ),
        structure=_structure(off.cpu().numpy(), samples.positions.cpu().numpy(), _NEIGHBOURS * samples.pitch)
        if samples.kind == "cores"
        else float("nan"),
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
    used, count = int(registration.used.sum()), len(registration.used)
    reasons: list[str] = []
    is_bad = False
    # A single look at the object has gaps that no sample left out can be predicted across.
    allowed = (1.0 if fit.is_noise_known else _WITH_NOISE) * max(1.0, _ENOUGH_FRAMES / max(1, used))
    if not registration.is_still and fit.error > _DOUBTFUL_ERROR * allowed:
        is_bad = fit.error > _BAD_ERROR * allowed
        reasons.append(
            f"samples that were left out are missed by {100 * fit.error:.0f} % of their contrast: the object "
            "moves or changes in other ways than by the motion that was found"
        )
    if fit.structure > _STRUCTURE:
        reasons.append(
            "what the image leaves unexplained is alike in neighbouring cores, so something else than noise is in it"
        )
    if fit.unevenness > _UNEVEN_FRAMES:
        reasons.append("many frames fit much worse than others: they are blurred, or out of focus")
    if count > 1 and used < max(2, _LEAST_USED * count):
        is_bad = is_bad or used < 2
        reasons.append(f"only {used} of {count} frames could be registered")
    is_few = 1 < count and used < _FEW_FRAMES
    if is_few and not gains_known:
        reasons.append(f"{used} frames tell little of the cores' gains; a bundle that is known would tell them")
    elif not gains_known and (registration.is_still or registration.travel < _SHORT_TRAVEL * pitch):
        reasons.append("the object moves too little to tell the cores' gains from its own light")
    quality: Quality = "bad" if is_bad else "doubtful" if reasons else "good"
    return Verdict(quality=quality, reasons=tuple(reasons))


def _structure(off: NDArray[np.float32], positions: NDArray[np.float32], reach: float) -> float:
    """Return the correlation of residuals (T, N), each core's mean over the frames left out, between neighbours."""
    known = np.isfinite(off)
    pairs = cKDTree(positions).query_pairs(reach, output_type="ndarray")
    if len(pairs) < 10 or len(off) < 3:
        return float("nan")
    values = np.where(known, off, 0.0).astype(np.float64)
    values = np.where(known, values - values.sum(axis=0) / np.maximum(known.sum(axis=0), 1), 0.0)
    first, second = (values[:, pairs[:, side]] * known[:, pairs[:, 1 - side]] for side in (0, 1))
    power = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return float((first * second).sum() / power) if power > 0 else float("nan")
