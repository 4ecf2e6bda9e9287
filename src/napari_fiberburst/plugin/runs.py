"""The runs that are kept, and what can be done with them."""

from napari.components import ViewerModel
from qtpy.QtCore import Qt, Signal
from qtpy.QtWidgets import QLabel, QPushButton, QSpinBox, QVBoxLayout, QWidget

from napari_fiberburst.plugin.compare import CompareBox
from napari_fiberburst.plugin.evidence import MOTION_KINDS
from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.runs_table import RunsTable
from napari_fiberburst.plugin.saving import SaveButtons
from napari_fiberburst.plugin.sections import row_of
from napari_fiberburst.settings import SplineMethod

_MORE_STEPS = 200


class RunsPanel(QWidget):
    """The table of runs, and what can be done with them.

    Parameters
    ----------
    viewer : ViewerModel
        Where their layers are.
    """

    chosen = Signal(object)  # KeptRun or None
    charted = Signal(object)  # all KeptRuns that are selected, or one of them has another name
    continue_asked = Signal(object, int)  # KeptRun, steps
    removed = Signal(object)  # KeptRun

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._runs: list[KeptRun] = []  # newest first
        self._removed: list[tuple[int, KeptRun]] = []  # where each was among the runs, the last removed at the end
        self._is_running = False
        self.table = RunsTable()
        self.compare = CompareBox(viewer)
        self.remove_button = QPushButton("Remove")
        self.remove_button.setToolTip("Forget the selected runs and take their layers out of the viewer.")
        self._undo, self.undo_button, self._what_was_removed = QWidget(), QPushButton("Undo remove"), QLabel()
        self.undo_button.setToolTip("Bring back what was removed last, with its layers; until the next run starts.")
        self.continue_button = QPushButton("Continue for")
        self._more_steps = QSpinBox()
        self.save = SaveButtons()
        self._lay_out()
        self._connect()
        self._tell_what_was_removed()
        self._follow()

    @property
    def run(self) -> KeptRun | None:
        """The run that is selected."""
        return self.table.run

    @property
    def runs(self) -> tuple[KeptRun, ...]:
        """All runs, oldest first."""
        return tuple(reversed(self._runs))

    @property
    def is_empty(self) -> bool:
        """Whether there is no run, and none that could be brought back."""
        return not self._runs and not self._removed

    def add(self, run: KeptRun) -> None:
        """Keep a run, in the first row, and select it; what was removed before is let go."""
        self._let_go()
        # Nobody can tell the outlines of two runs apart, and all that is shown makes each drawing slower.
        for before in self._runs:
            for kind in MOTION_KINDS:
                before.layers.switch(kind, False)
        self._runs.insert(0, run)
        self.table.add(run)

    def select(self, run: KeptRun) -> None:
        """Select a run."""
        self.table.select(run)

    def refresh(self) -> None:
        """Show what has become of the runs."""
        self.table.refresh()
        self._follow()

    def remove(self, *runs: KeptRun) -> None:
        """Take runs and their layers away; those that have a result can be brought back, until the next ones go."""
        self.compare.stop()
        self._let_go()
        for run in runs:
            at = self._runs.index(run)
            self.table.take_out(run)
            self._runs.remove(run)
            if run.result is None:
                run.layers.remove()
            else:
                run.layers.take_out()
                self._removed.append((at, run))
        self._tell_what_was_removed()
        self._follow()
        for run in runs:
            self.removed.emit(run)
        self.chosen.emit(self.run)
        if self.run is not None:
            self.select(self.run)  # it is the current one, but not selected
        self.charted.emit(self.table.selected)

    def undo_remove(self) -> None:
        """Bring back what was removed last."""
        self.compare.stop()
        removed, self._removed = self._removed, []
        for at, run in reversed(removed):
            run.layers.put_back()
            self._runs.insert(at, run)
            self.table.add(run, at)
        self._tell_what_was_removed()

    def set_running(self, is_running: bool) -> None:
        """Lock what would disturb a running fit."""
        self._is_running = is_running
        self._follow()

    def _lay_out(self) -> None:
        self._more_steps.setRange(1, 10**6)
        self._more_steps.setValue(_MORE_STEPS)
        self._more_steps.setSuffix(" more steps")
        self._more_steps.setAccessibleName("steps to go on for")
        self._more_steps.setToolTip("How many steps a network is taken further.")
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.table)
        self._what_was_removed.setWordWrap(True)
        self._what_was_removed.setTextFormat(Qt.TextFormat.PlainText)  # with names that users have given
        undo = row_of(self._what_was_removed, self.undo_button)
        undo.setStretch(0, 1)
        undo.setContentsMargins(0, 0, 0, 0)
        self._undo.setLayout(undo)
        layout.addWidget(self._undo)
        layout.addWidget(self.save)
        layout.addWidget(self.compare)
        layout.addLayout(row_of(self.continue_button, self._more_steps, self.remove_button))

    def _connect(self) -> None:
        self.table.chosen.connect(self._take_choice)
        self.table.marked.connect(self._take_marks)
        self.table.renamed.connect(self._rename)
        self.remove_button.clicked.connect(lambda: self.remove(*self.table.selected))
        self.undo_button.clicked.connect(self.undo_remove)
        self.continue_button.clicked.connect(lambda: self.continue_asked.emit(self.run, self._more_steps.value()))

    def _follow(self) -> None:
        """Offer what makes sense for the run that is selected."""
        run = self.run
        result = None if run is None else run.result
        has_result = result is not None
        self.save.show_run(run)
        self._follow_marks()
        self.compare.offer(run, [other for other in self._runs if other is not run])
        is_network = result is not None and not isinstance(result.settings.method, SplineMethod)
        self.continue_button.setEnabled(is_network and not self._is_running)
        self._more_steps.setEnabled(is_network and not self._is_running)
        self.continue_button.setToolTip(
            "Go on from this result."
            if is_network or not has_result
            else "A spline is solved to its end, not trained: there is nothing to continue. Networks can go on."
        )

    def _follow_marks(self) -> None:
        """Let runs be removed, but for the one that is going."""
        marked = self.table.selected
        is_one_going = self._is_running and any(run.result is None for run in marked)
        self.remove_button.setEnabled(bool(marked) and not is_one_going)

    def _tell_what_was_removed(self) -> None:
        names = [run.name for _, run in self._removed]
        self._what_was_removed.setText(f"removed: {', '.join(names)}")
        self._undo.setVisible(bool(names))
        self.undo_button.setEnabled(bool(names))

    def _let_go(self) -> None:
        """Let go of what was removed: it cannot be brought back any more."""
        for _, run in self._removed:
            run.layers.remove()
        self._removed = []
        self._tell_what_was_removed()

    def _take_marks(self) -> None:
        self._follow_marks()
        self.charted.emit(self.table.selected)

    def _take_choice(self) -> None:
        self._follow()
        self.chosen.emit(self.run)

    def _rename(self, run: KeptRun, name: str) -> None:
        if name and name != run.name:
            run.name = name
            run.layers.rename(name)
        self.refresh()
        self.charted.emit(self.table.selected)
