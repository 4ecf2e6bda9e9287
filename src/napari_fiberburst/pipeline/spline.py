"""The default method at work: the stages, and the scene as a spline."""

from collections.abc import Generator

import torch

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.memory import MemoryLimit
from napari_fiberburst.pipeline.again import Again
from napari_fiberburst.pipeline.fitted import Fitted
from napari_fiberburst.pipeline.outcome import Order
from napari_fiberburst.pipeline.stages import Stages
from napari_fiberburst.pipeline.supervise import Clock, Snapshot
from napari_fiberburst.results.diagnostics import Ending
from napari_fiberburst.results.reconstruction import Reconstruction, draw
from napari_fiberburst.settings import Settings, SplineMethod

# Rounds and stages that a fit has, about: what is left is counted in these.
_PLANNED = 27


class SplineFit:
    """A fit by stages; see `napari_fiberburst.pipeline.supervise.Fit`.

    Parameters
    ----------
    burst : Burst
        What to fit.
    requested : Settings
        What was asked for.
    method : SplineMethod
        How to fit it: the method asked for, or the alignment of a network's.
    device : torch.device
        Where.
    given : Bundle, optional
        The bundle, where it is known.
    limit : MemoryLimit, optional
        What the run may take.
    """

    def __init__(
        self,
        burst: Burst,
        requested: Settings,
        method: SplineMethod,
        device: torch.device,
        given: Bundle | None,
        limit: MemoryLimit | None = None,
    ) -> None:
        self._burst = burst
        self._order = Order(acquisition=burst.acquisition, requested=requested, method=method, device=device)
        self._stages = Stages(burst, method, device, seed=requested.seed, given=given, limit=limit)
        self._losses: list[float] = []
        self._fitted: Fitted | None = None
        self._aligned: Fitted | None = None

    @property
    def fitted(self) -> Fitted:
        """What is known; only after `conclude`, or once the steps are done."""
        assert self._fitted is not None
        return self._fitted

    def steps(self, clock: Clock) -> Generator[Snapshot | None, None, Ending]:
        """Align, then solve."""
        self._aligned = yield from self.align()
        yield from self._watched(self._stages.solve(self._aligned))
        return "finished"

    def align(self) -> Generator[Snapshot | None, None, Fitted]:
        """Do all but solve the scene: calibrate, register, decide what a sample is."""
        return (yield from self._watched(self._stages.align()))

    def conclude(self, ending: Ending) -> tuple[Snapshot, Ending]:
        """Draw what there is."""
        if ending != "finished":
            self.round_off()
        return self._snapshot(None, is_last=True), ending

    def round_off(self) -> Fitted:
        """Make what is known belong together, with a first image of it."""
        self._fitted = self._stages.round_off(self._fitted)
        return self._fitted

    def result(self, ending: Ending, seconds: float) -> Reconstruction:
        """Return the reconstruction."""
        again = None
        if ending == "finished" and self._aligned is not None:
            again = Again(self._order, self._aligned, self.fitted, self._losses, seconds)
        return self._order.outcome(self.fitted, self._losses, ending, seconds, again)

    def _watched(self, stages: Generator[Fitted | None, None, Fitted]) -> Generator[Snapshot | None, None, Fitted]:
        """Keep what is known, and make a snapshot of it after every stage."""
        while True:
            before = self._fitted
            try:
                self._fitted = next(stages)
            except StopIteration as end:
                self._fitted = end.value
                return self.fitted
            yield None if self._fitted is None else self._snapshot(before)

    def _snapshot(self, before: Fitted | None, *, is_last: bool = False) -> Snapshot:
        """Return a snapshot, with the image where it is another one than before."""
        fitted = self.fitted
        image = fitted.image
        is_new = image is not None and (before is None or before.image is not image)
        # Of intensities in [-1, 1]: twice the full scale of 1.
        self._losses.append(4 * fitted.registration.residual**2)
        step = len(self._losses)
        error = None if fitted.scene is None else fitted.scene.held_out_rmse
        return Snapshot(
            step=step,
            planned=max(_PLANNED, step + 1),
            loss=self._losses[-1],
            homographies=fitted.recorded.reference_from_frame,
            settings=self._order.chosen(fitted, is_last=is_last),
            canvas=fitted.canvas,
            draw=(lambda: draw(image, fitted.canvas, fitted.registration.reference, self._burst))
            if image is not None and is_new
            else None,
            is_milestone=True,
            held_out_rmse=None if error is None else error * (self._burst.white_level - self._burst.black_level),
        )
