"""One call of `reconstruct`, to be made in another thread. Knows nothing of Qt."""

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.control import Control
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.plugin.bursts import BurstSource, Truth
from napari_fiberburst.plugin.drivers import without_clash
from napari_fiberburst.streaming import Latest

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle
    from napari_fiberburst.data.burst import Acquisition
    from napari_fiberburst.results.progress import Progress
    from napari_fiberburst.results.reconstruction import Reconstruction
    from napari_fiberburst.settings import Settings

logger = logging.getLogger(__name__)

# Comparing an image with the truth takes as long as some steps do, and must not slow the run down.
_SCORING_SHARE = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """How close an image and a motion are to a simulated burst's truth.

    Attributes
    ----------
    psnr : float
        dB, frame 0, after one gain and offset per channel.
    ssim : float
        Of the same.
    motion_error : float
        Mean distance in pixels, gauge removed.
    """

    psnr: float
    ssim: float
    motion_error: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CurvePoint:
    """One point of the curves a run draws.

    Attributes
    ----------
    seconds : float
        Since the run's first step.
    loss : float
        As in `Progress`.
    held_out_rmse : float or None
        As in `Progress`.
    scores : Scores or None
        Where they were taken at this point.
    """

    seconds: float
    loss: float
    held_out_rmse: float | None
    scores: Scores | None


class Job:
    """A run in the making: what it works on, how it is steered, and what it has said so far.

    Parameters
    ----------
    source : BurstSource
        The burst, still in its layers.
    choices : mapping
        What `napari_fiberburst.reconstruct` takes by name.
    bundle : Bundle or array, optional
        The bundle, or an image of it in even light.
    initial : Reconstruction, optional
        To continue from.

    Attributes
    ----------
    control : Control
        To stop, pause and steer it.
    acquisition : Acquisition or None
        What is known of the burst, once it is read.
    bundle : Bundle or None
        The bundle that was given, once it is calibrated.
    reports, previews : Latest
        The newest `Progress`, and the newest one with a preview, for whoever looks.
    curve : list of CurvePoint
        All points so far; grows at its end alone.
    result : Reconstruction or None
        Once there is one.
    problem : str
        Why there is none, in words for the user.
    """

    def __init__(
        self,
        source: BurstSource,
        choices: Mapping[str, Any],
        *,
        bundle: "Bundle | NDArray[Any] | None" = None,
        initial: "Reconstruction | None" = None,
    ) -> None:
        self._source: BurstSource | None = source
        self._choices = dict(choices)
        self._given, self._initial = bundle, initial
        self._truth = truth_of(source)
        self._scored = self._scoring = 0.0
        self.control = Control()
        self.acquisition: Acquisition | None = None
        self.bundle: Bundle | None = None
        self.reports: Latest[Progress] = Latest()
        self.previews: Latest[Progress] = Latest()
        self.curve: list[CurvePoint] = []
        self.result: Reconstruction | None = None
        self.problem = ""

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Make the call. Raises nothing, because a worker's errors reach the window by more than one way."""
        # torch takes seconds to load, which the window must not wait for.
        from napari_fiberburst.pipeline.reconstruct import as_bundle, reconstruct

        assert self._source is not None
        try:
            burst = self._source.read()
            self.acquisition = burst.acquisition
            with without_clash():
                if self._given is not None:
                    self.bundle = as_bundle(self._given)
                result = reconstruct(
                    burst,
                    **self._choices,
                    bundle=self.bundle,
                    initial=self._initial,
                    control=self.control,
                    should_stop=should_stop,
                    on_progress=self._take,
                )
            if not np.isfinite(result.image).any():
                raise FiberBurstError(
                    f"the fit came to no numbers ({result.ending}); try the preset auto, or a lower learning rate"
                )
            self.result = result
        except FiberBurstError as error:
            self.problem = str(error)
        except Exception as error:  # whatever it is, the window must hear of it and be ready again
            logger.exception("the reconstruction failed")
            self.problem = _explain(error)

    def release(self) -> None:
        """Let go of all that is large. napari keeps every worker, and a worker its job, as long as the viewer."""
        self._source = self._initial = self._given = self.bundle = self._truth = self.result = None
        self.reports, self.previews = Latest(), Latest()
        self.curve = []

    def _take(self, report: "Progress") -> None:
        scores = self._score(report)
        self.curve.append(
            CurvePoint(seconds=report.seconds, loss=report.loss, held_out_rmse=report.held_out_rmse, scores=scores)
        )
        self.reports.put(report)
        if report.preview is not None:
            self.previews.put(report)

    def _score(self, report: "Progress") -> Scores | None:
        """Compare with the truth where there is one and an image, now and then."""
        began = time.perf_counter()
        is_soon = began - self._scored < self._scoring / _SCORING_SHARE and report.remaining != 0
        if self._truth is None or report.preview is None or is_soon:
            return None
        scores = scores_of(report.preview, report.homographies, report.settings, self._truth)
        self._scored = time.perf_counter()
        self._scoring = self._scored - began
        return scores


def scores_of(
    image: NDArray[np.float32], homographies: NDArray[np.float64], settings: "Settings", truth: Truth | None
) -> Scores | None:
    """Compare an image and a motion with the truth; None where there is none, or they are not over frame 0."""
    is_over_frame = settings.flat().get("canvas", "frame") == "frame" and np.allclose(
        homographies[0], np.eye(3), atol=1e-6
    )
    return score(image, homographies, truth) if truth is not None and is_over_frame else None


def score(image: NDArray[np.float32], homographies: NDArray[np.float64], truth: Truth) -> Scores:
    """Compare an image of frame 0's field, at any scale, and a motion with the truth."""
    from skimage.transform import resize

    from napari_fiberburst.quality import motion_error, psnr, ssim

    shown = image if image.ndim == 3 else image[..., None]
    known = np.isfinite(shown)
    # Pixels that no core has seen take the mean, because there is nothing to compare.
    shown = np.where(known, shown, shown.mean(axis=(0, 1), where=known))
    wanted = truth.image
    if shown.shape != wanted.shape:
        shown = resize(shown, wanted.shape, anti_aliasing=True, preserve_range=True)
    return Scores(
        psnr=psnr(shown, wanted),
        ssim=ssim(shown, wanted),
        motion_error=motion_error(homographies, truth.homographies, wanted.shape[:2]),
    )


def truth_of(source: BurstSource) -> Truth | None:
    """Return the truth of the region that is used; None where it is not known."""
    truth = source.truth
    if truth is None or source.region is None:
        return truth
    (y0, y1), (x0, x1) = source.region
    inside = np.array([[1, 0, x0], [0, 1, y0], [0, 0, 1]], dtype=np.float64)
    return Truth(
        image=truth.image[y0:y1, x0:x1],
        homographies=np.linalg.inv(inside) @ truth.homographies @ inside,
    )


def _explain(error: Exception) -> str:
    """Say what an unforeseen error means for the user; torch raises a RuntimeError where there is too little memory."""
    words = str(error).lower()
    if isinstance(error, MemoryError) or "out of memory" in words or "allocate memory" in words:
        return (
            "there was not enough memory for this run; draw a region, use fewer frames, lower the upsampling, or "
            f"choose another device ({type(error).__name__}: {error})"
        )
    return (
        f"the run failed for a reason that was not foreseen ({type(error).__name__}: {error}); if it happens again, "
        "please report it with what the terminal says"
    )


def load_solver() -> dict[str, str]:
    """Load PyTorch, which takes seconds, ahead of the first run; return the devices that are not here, and why.

    What napari makes shapes with is loaded too, pandas among it, because the first outlines would wait for it.
    """
    from napari.layers import Shapes

    from napari_fiberburst.device import missing_devices

    missing = missing_devices()
    Shapes(np.array([[0.0, 0.0], [1.0, 1.0]]), shape_type="rectangle")
    return missing
