"""The scene of a run that has ended, solved again: smoother, sharper, or without some of its frames.

Frames, gains and exposures stay as they were found, so all that is left is linear. `Again` goes the way that the run
went from there on, and comes to the same bits as a run with those settings. `Look` takes the shortest way to an image
that looks the same, because somebody waits for it.
"""

import time
from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.pipeline.fitted import Fitted
from napari_fiberburst.pipeline.outcome import Order
from napari_fiberburst.pipeline.scenes import Scenes
from napari_fiberburst.results.reconstruction import Reconstruction, draw
from napari_fiberburst.scene.solve import Scene
from napari_fiberburst.scene.spline import NormalEquations, assemble
from napari_fiberburst.settings import SplineMethod
from napari_fiberburst.steps import drain

# Iterations of conjugate gradients for an image that somebody waits for: at ten times the smoothness it is off by a
# thousandth of full scale then, and what it was before by twenty.
_ITERATIONS = 14


class Again:
    """Solves the scene of one run again; see `napari_fiberburst.results.reconstruction.Solver`.

    It holds the samples and a first scene, and none of the frames.

    Parameters
    ----------
    order : Order
        What the run was asked to do.
    aligned : Fitted
        What was known before its scene was solved, samples included.
    solved : Fitted
        What is known now that it is.
    losses : list of float
        Of the run.
    seconds : float
        That the run took.
    """

    def __init__(self, order: Order, aligned: Fitted, solved: Fitted, losses: list[float], seconds: float) -> None:
        assert solved.draft is not None
        assert solved.scene is not None
        self.order, self.draft = order, solved.draft
        self.coefficients, self.smoothness = solved.scene.coefficients, solved.scene.smoothness
        # Previews of the way are of no use any more.
        self.aligned = replace(aligned, scene=None, image=None, draft=None)
        # Where frames were smeared, the draft is of other places than they were first aligned to.
        self.placed = replace(self.aligned, registration=solved.registration)
        self._losses, self._seconds = losses, seconds

    def solve(self, *, smoothness: float | None = None, leave_out: Collection[int] = ()) -> Reconstruction:
        """Solve and judge the scene; see `Reconstruction.solve_again`."""
        began = time.perf_counter()
        order = self.turned(smoothness, leave_out)
        # A draft holds what the frames that take part have told, so it is of no use without one of them.
        is_same = order.method.leave_out == self.order.method.leave_out
        is_told = order.method.smoothness is not None or self.draft.smoothness is not None
        scenes = Scenes(order.acquisition, order.method, order.requested.seed)
        if is_same and is_told:
            fitted = drain(scenes.solve(self.placed, self.draft))
        else:
            fitted = drain(scenes.solve(self.aligned))
        took = time.perf_counter() - began
        return order.outcome(fitted, self._losses, "finished", self._seconds + took, self)

    def look(self) -> "Look":
        """Return what draws the scene while somebody turns it."""
        return Look(self)

    def turned(self, smoothness: float | None, leave_out: Collection[int]) -> Order:
        """Return the run's order with these settings.

        Raises
        ------
        SettingsError
            They are out of range.
        """
        asked = {"smoothness": smoothness, "leave_out": tuple(sorted(set(leave_out)))}
        method = replace(self.order.method, **asked)  # type: ignore[arg-type]
        return replace(self.order, method=method, requested=replace(self.order.requested, method=method))


class Look:
    """Draws the scene of a run as it will be at other settings, as fast as that can be had.

    What the run has learned of gains, outliers and blur by motion is taken as it is; the equations are assembled once
    for each choice of frames, and conjugate gradients start near to where they end, from the scene of the run.

    Parameters
    ----------
    again : Again
        Of the run.
    """

    def __init__(self, again: Again) -> None:
        self._again = again
        self._assembled: tuple[tuple[int, ...], Fitted, NormalEquations] | None = None

    def image(
        self, *, smoothness: float | None = None, leave_out: Collection[int] = ()
    ) -> tuple[NDArray[np.float32], Canvas]:
        """Return the image, (H, W) or (H, W, C) in the burst's intensity units, and where it lies.

        Parameters
        ----------
        smoothness, leave_out
            As for `Reconstruction.solve_again`; without a smoothness, the one that was chosen from all frames.
        """
        order, draft = self._again.turned(smoothness, leave_out), self._again.draft
        scenes = Scenes(order.acquisition, order.method, order.requested.seed)
        fitted, equations = self._equations(order.method, scenes)
        weight = smoothness or draft.smoothness or self._again.smoothness
        assert fitted.samples is not None
        scene = Scene(
            coefficients=equations.solve(weight, self._start(equations, weight), _ITERATIONS),
            smoothness=weight,
            equations=equations,
            samples=fitted.samples,
            gains=draft.gains,
        )
        image = scenes.with_scene(fitted, scene).image
        assert image is not None
        return draw(image, fitted.canvas, fitted.registration.reference, order.acquisition), fitted.canvas

    def _equations(self, method: SplineMethod, scenes: Scenes) -> tuple[Fitted, NormalEquations]:
        """Return what is known without the frames left out, and the equations of the others' samples."""
        if self._assembled is not None and self._assembled[0] == method.leave_out:
            return self._assembled[1:]
        draft = self._again.draft
        fitted = scenes.without_left_out(self._again.placed)
        samples = fitted.samples
        assert samples is not None
        fitted = replace(fitted, canvas=scenes.canvas(fitted.registration, samples))
        looks = draft.looks(samples, fitted.registration)
        equations = assemble(scenes.grid(fitted), draft.refined(samples, fitted.registration), looks)
        self._assembled = method.leave_out, fitted, equations
        return fitted, equations

    def _start(self, equations: NormalEquations, smoothness: float) -> Tensor | None:
        """Return about what the run's scene becomes at this smoothness; None where it is on another grid."""
        scene = self._again.coefficients
        if scene.shape[1:] != equations.grid.shape:
            return None
        return equations.carried(scene, self._again.smoothness, smoothness)
