"""What a burst itself says of an image: what the scene leaves unexplained, against what noise and an honest fit leave.

Errors are parts of how much the object changes in the samples as it moves, because the bundle's own pattern, a dark rim
or burned-in marks are contrast that any image explains.
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
from napari_fiberburst.scene.halves import disagreement
from napari_fiberburst.scene.prediction import predict
from napari_fiberburst.scene.solve import Scene

# Part of the cores that are not among the worst.
_WORST = 0.99
# Cores' gains are not known better than to this part, so errors of this part of the light are to be expected.
_GAIN_ERROR = 0.01
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
    return _mean(samples.weights, (samples.grey - samples.mean_light).square())


def _falloff(samples: Samples) -> float:
    """Return how much brighter the middle of the frame is than the edge of its longer side: by a parabola in logs."""
    mass = samples.weights.sum(dim=0)
    light = samples.mean_light
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
