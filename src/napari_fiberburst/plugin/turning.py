"""The scene of a run that has ended, turned by its user: drawn at once, solved and judged when the user rests."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from napari.utils.notifications import show_error
from qtpy.QtCore import QObject, QTimer, Signal
from superqt.utils import create_worker

from napari_fiberburst.plugin.bursts import Truth
from napari_fiberburst.plugin.calls import as_python
from napari_fiberburst.plugin.drivers import without_clash
from napari_fiberburst.plugin.job import Scores, scores_of, truth_of
from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.problems import why

if TYPE_CHECKING:
    from napari_fiberburst.results.reconstruction import Look, Reconstruction, Solver

# A scene is judged once nobody has turned it for so long.
_REST_MILLISECONDS = 600
_TURNED = ("smoothness", "leave_out")


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn:
    """What a user asks of a scene.

    Attributes
    ----------
    smoothness : float or None
        None lets the burst choose.
    leave_out : tuple of int
        Frames, in order.
    """

    smoothness: float | None = None
    leave_out: tuple[int, ...] = ()

    @property
    def choices(self) -> dict[str, Any]:
        """What differs from a run's usual settings, as `reconstruct` takes it by name."""
        values = {name: getattr(self, name) for name in _TURNED}
        return {name: value for name, value in values.items() if value not in (None, ())}


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A scene that was solved and judged.

    Attributes
    ----------
    result : Reconstruction
        What it has come to.
    scores : Scores or None
        Against the truth, where that is known.
    """

    result: "Reconstruction"
    scores: Scores | None

    @property
    def turn(self) -> Turn:
        """What was asked for."""
        values = {name: self.result.requested.value_of(name) for name in _TURNED}
        return Turn(**values)


class Turning(QObject):
    """Turns the scene of one run.

    Each turn is drawn in another thread, the newest first; those between are passed over. While a scene is turned, the
    run has no result: what was judged is no longer shown, and what is shown is not judged yet. When the user rests, the
    scene is solved and judged in another thread, and becomes the run's result.

    Parameters
    ----------
    run : KeptRun
        With a result that can be solved again.
    parent : QObject
        Who owns it.
    """

    changed = Signal(object)  # the KeptRun, which shows something else now

    def __init__(self, run: KeptRun, parent: QObject) -> None:
        super().__init__(parent)
        assert run.result is not None
        assert run.result.solver is not None
        self.run = run
        self._first = self._judged = Judged(run.result, run.scores)
        self._solver = run.result.solver
        self._choices = {name: value for name, value in run.choices.items() if name not in _TURNED}
        self._look: Look | None = None
        self.asked = self.as_chosen = self._first.turn
        self._is_looking = self._is_judging = False
        self._rest = QTimer(self)
        self._rest.setSingleShot(True)
        self._rest.setInterval(_REST_MILLISECONDS)
        self._rest.timeout.connect(self._judge)

    @property
    def smoothness(self) -> float:
        """The smoothness that is asked for; where the burst is to choose it, what it has chosen last."""
        return self.asked.smoothness or float(self._judged.result.settings.value_of("smoothness"))

    @property
    def count(self) -> int:
        """How many frames there are."""
        return len(self._judged.result.homographies)

    def turn(self, asked: Turn) -> None:
        """Show the scene as it is asked for."""
        if asked == self.asked:
            return
        self.asked = asked
        self._rest.stop()
        for known in (self._judged, self._first):
            if asked == known.turn:
                self._finish(known)
                return
        if self.run.result is not None:
            self.run.result = None
            self.run.layers.unfinish()
        self.run.layers.leave_out(asked.leave_out)
        self.changed.emit(self.run)
        self._draw()

    def rest(self) -> None:
        """Judge without further delay, because the user looks elsewhere, and keep no more than is needed."""
        self._look = None
        if self._rest.isActive():
            self._rest.stop()
            self._judge()

    def _draw(self) -> None:
        if not self._is_looking:
            self._is_looking = True
            self._look = self._look or self._solver.look()
            self._work(_drawn, (self._look, self.asked), self._take_image, self._miss_image)

    def _take_image(self, drawn: tuple[Turn, Any, Any]) -> None:
        self._is_looking = False
        turn, image, canvas = drawn
        if self.run.result is not None:
            return  # turned back meanwhile
        self.run.layers.show_image(image, self._judged.result.acquisition, canvas)
        if turn != self.asked:
            self._draw()
        else:
            self._rest.start()

    def _miss_image(self, error: Exception) -> None:
        self._is_looking = False
        self._give_up(error)

    def _judge(self) -> None:
        if not self._is_judging:
            self._is_judging = True
            work = self._solver, self.asked, truth_of(self.run.source)
            self._work(_solved, work, self._take_result, self._miss_result)

    def _take_result(self, judged: "Judged") -> None:
        self._is_judging = False
        if judged.turn == self.asked and self.run.result is None:
            self._finish(judged)
        elif self.run.result is None and not self._is_looking:
            self._rest.start()

    def _miss_result(self, error: Exception) -> None:
        self._is_judging = False
        self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        """Go back to what was judged last."""
        show_error(f"{self.run.name} could not be solved again: {why(error, 'solving again failed')}")
        self.asked = self._judged.turn
        self._finish(self._judged)

    def _finish(self, judged: "Judged") -> None:
        """Make this the run's result, and what is told of the run agree with it."""
        run, self._judged = self.run, judged
        run.result, run.scores = judged.result, judged.scores
        run.choices = {**self._choices, **judged.turn.choices}
        run.python = as_python(run.source, run.choices, run.bundle)
        for name in ("choices", "python"):
            run.layers.tell(name, getattr(run, name))
        run.layers.finish(judged.result, run.source.frames)
        self.changed.emit(run)

    def _work(self, task: Callable[..., Any], args: tuple[Any, ...], take: Any, miss: Any) -> None:
        create_worker(task, *args, _connect={"returned": take, "errored": miss}, _ignore_errors=True)


def _drawn(look: "Look", turn: Turn) -> tuple[Turn, Any, Any]:
    with without_clash():
        return (turn, *look.image(smoothness=turn.smoothness, leave_out=turn.leave_out))


def _solved(solver: "Solver", turn: Turn, truth: Truth | None) -> Judged:
    with without_clash():
        result = solver.solve(smoothness=turn.smoothness, leave_out=turn.leave_out)
    return Judged(result, scores_of(result.image, result.homographies, result.settings, truth))


def with_frame(turn: Turn, frame: int) -> Turn:
    """Return a turn with one frame left out, or taken in again where it was left out."""
    return replace(turn, leave_out=tuple(sorted({*turn.leave_out} ^ {frame})))
