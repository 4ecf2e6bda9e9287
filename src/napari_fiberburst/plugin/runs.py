"""The runs that are kept, and what can be done with them."""

from napari.components import ViewerModel
from qtpy.QtCore import Signal
from qtpy.QtWidgets import QPushButton, QSpinBox, QVBoxLayout, QWidget

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
    continue_asked = Signal(object, int)  # KeptRun, steps
    removed = Signal(object)  # KeptRun

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._runs: list[KeptRun] = []  # newest first
        self._is_running = False
        self.table = RunsTable()
        self.compare = CompareBox(viewer)
        self.remove_button = QPushButton("Remove")
        self.remove_button.setToolTip("Forget this run and take its layers out of the viewer.")
        self.continue_button = QPushButton("Continue for")
        self._more_steps = QSpinBox()
        self.save = SaveButtons()
        self._lay_out()
        self._connect()
        self._follow()

    @property
    def run(self) -> KeptRun | None:
        """The run that is selected."""
        return self.table.run

    @property
    def runs(self) -> tuple[KeptRun, ...]:
        """All runs, oldest first."""
        return tuple(reversed(self._runs))

    def add(self, run: KeptRun) -> None:
        """Keep a run, in the first row, and select it."""
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

    def remove(self, run: KeptRun) -> None:
        """Forget a run and take its layers away."""
        self.compare.stop()
        self.table.take_out(run)
        self._runs.remove(run)
        run.layers.remove()
        self._follow()
        self.removed.emit(run)
        self.chosen.emit(self.run)

    def set_running(self, is_running: bool) -> None:
        """Lock what would disturb a running fit."""
        self._is_running = is_running
        self._follow()

    def _lay_out(self) -> None:
        self._more_steps.setRange(1, 10**6)
        self._more_steps.setValue(_MORE_STEPS)
        self._more_steps.setSuffix(" more steps")
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.table)
        layout.addWidget(self.compare)
        layout.addLayout(row_of(self.continue_button, self._more_steps, self.remove_button))
        layout.addWidget(self.save)

    def _connect(self) -> None:
        self.table.chosen.connect(self._take_choice)
        self.table.renamed.connect(self._rename)
        self.remove_button.clicked.connect(lambda: self.remove(self.run) if self.run is not None else None)
        self.continue_button.clicked.connect(lambda: self.continue_asked.emit(self.run, self._more_steps.value()))

    def _follow(self) -> None:
        """Offer what makes sense for the run that is selected."""
        run = self.run
        result = None if run is None else run.result
        has_result = result is not None
        self.save.show_run(run)
        self.remove_button.setEnabled(has_result or (run is not None and not self._is_running))
        self.compare.offer(run, [other for other in self._runs if other is not run])
        is_network = result is not None and not isinstance(result.settings.method, SplineMethod)
        self.continue_button.setEnabled(is_network and not self._is_running)
        self._more_steps.setEnabled(is_network and not self._is_running)
        self.continue_button.setToolTip(
            "Go on from this result."
            if is_network or not has_result
            else "A spline is solved to its end, not trained: there is nothing to continue. Networks can go on."
        )

    def _take_choice(self) -> None:
        self._follow()
        self.chosen.emit(self.run)

    def _rename(self, run: KeptRun, name: str) -> None:
        if name and name != run.name:
            run.name = name
            run.layers.rename(name)
        self.refresh()
