"""The supervisor: when images of a network are drawn, by a clock of the test's own."""

from types import SimpleNamespace

import numpy as np
import pytest

from napari_fiberburst import Control
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.pipeline.supervise import Snapshot, supervise
from napari_fiberburst.settings import choose

STEP = 0.15


class Clockwork:
    """A fit of so many steps of a clock that only steps and drawings move."""

    def __init__(self, steps, drawing):
        self.now, self.drawn = 0.0, []
        self._steps, self._drawing = steps, drawing

    def steps(self, clock):
        for number in range(1, self._steps + 1):
            self.now += STEP
            yield self._snapshot(number)
        return "finished"

    def conclude(self, ending):
        return None, ending

    def result(self, ending, seconds):
        return SimpleNamespace(ending=ending)

    def _snapshot(self, number):
        return Snapshot(
            step=number,
            planned=self._steps,
            loss=1.0,
            homographies=np.eye(3)[None],
            settings=choose("paper"),
            canvas=Canvas.over((0, 0, 7, 5), 1),
            draw=self._draw,
            is_milestone=False,
        )

    def _draw(self):
        self.now += self._drawing
        self.drawn.append(self.now)
        return np.zeros((5, 7), np.float32)


@pytest.mark.parametrize(
    ("drawing", "longest", "share"),
    [
        (0.01, 0.5, 0.05),  # cheap: as often as is asked for
        (0.04, 1.0, 0.06),  # as often as a twentieth of the time allows
        (0.42, 2.0, 0.25),  # dear: every two seconds
        (5.0, 21.0, 0.25),  # so dear that the fit comes first
    ],
)
def test_images_come_soon_and_do_not_take_the_time_of_the_fit(monkeypatch, drawing, longest, share):
    fit = Clockwork(400, drawing)
    monkeypatch.setattr("napari_fiberburst.pipeline.supervise.time.perf_counter", lambda: fit.now)
    for _ in supervise(fit, choose("paper", preview_every=0.25), Control(), None):
        pass
    assert np.diff(fit.drawn).max() < longest
    assert len(fit.drawn) * drawing < share * fit.now
