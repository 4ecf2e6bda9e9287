"""What is kept of each run: settings, result, time and layers; two of them side by side; and how they are saved."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari.utils.notifications import show_error, show_info
from qtpy.QtCore import Qt, Signal
from qtpy.QtWidgets import (
    QComboBox,
    QFileDialog,
    QLabel,
    QListWidget,
    QListWidgetItem,
    QPushButton,
    QSpinBox,
    QVBoxLayout,
    QWidget,
)

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.io.results import write_homographies
from napari_fiberburst.plugin.bursts import BurstSource
from napari_fiberburst.plugin.history import History
from napari_fiberburst.plugin.job import Scores
from napari_fiberburst.plugin.layers import RunLayers
from napari_fiberburst.plugin.sections import row_of
from napari_fiberburst.settings import SplineMethod

if TYPE_CHECKING:
    from napari.layers import Layer

    from napari_fiberburst.results.reconstruction import Reconstruction

_LINES_OF_RUNS = 4
_MORE_STEPS = 200


@dataclass(kw_only=True, eq=False)
class KeptRun:
    """One run: what it was asked, what came of it, and its layers.

    Attributes
    ----------
    name : str
        The user's to change.
    python : str
        The call, as lines of Python.
    calibration : Layer or None
        With the calibration image that it was given.
    source : BurstSource
        The burst.
    choices : dict
        What `reconstruct` was given by name.
    layers : RunLayers
        In the viewer.
    history : History
        The pictures on the way.
    turned_live : list of (float, str, object)
        Seconds, knob and value of what was changed while it ran; the call does not tell of that.
    result : Reconstruction or None
        Once it has ended.
    scores : Scores or None
        The last ones, where the truth is known.
    """

    name: str
    python: str
    source: BurstSource
    choices: Mapping[str, Any]
    layers: RunLayers
    calibration: "Layer | None" = None
    history: History = field(default_factory=History)
    turned_live: list[tuple[float, str, Any]] = field(default_factory=list)
    result: "Reconstruction | None" = None
    scores: Scores | None = None

    @property
    def summary(self) -> str:
        """What came of it, in a few lines."""
        result = self.result
        if result is None:
            return ""
        used = "" if result.frames_used is None else f", {len(result.frames_used)} of {len(result.homographies)} frames"
        lines = [f"{result.ending} in {result.seconds:.1f} s on {result.device}{used}"]
        if result.resolution is not None:
            size, unit = result.acquisition.pixel_size, result.acquisition.unit
            length = "" if size is None else f" = {result.resolution * sum(size) / 2:.3g} {unit}"
            lines.append(f"halves of the burst agree down to {result.resolution:.1f} px{length}")
        if self.scores is not None:
            scores = self.scores
            lines.append(
                f"against the truth: PSNR {scores.psnr:.1f} dB, SSIM {scores.ssim:.3f}, motion off by "
                f"{scores.motion_error:.2g} px"
            )
        return "\n".join([*lines, *(f"Note: {note}" for note in result.notes)])


class RunsPanel(QWidget):
    """The list of runs, and what can be done with them."""

    chosen = Signal(object)  # KeptRun or None
    continue_asked = Signal(object, int)  # KeptRun, steps
    removed = Signal(object)  # KeptRun

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._runs: list[KeptRun] = []
        self._is_running = False
        self._list = QListWidget()
        self._list.setMaximumHeight(_LINES_OF_RUNS * self.fontMetrics().height() + 16)
        self._list.setToolTip("The runs so far; double-click one to name it.")
        self._summary = QLabel()
        self._summary.setWordWrap(True)
        self._summary.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self._other = QComboBox()
        self._other.setToolTip("The run to compare with the one selected above.")
        self._compare = QPushButton("A / B")
        self._compare.setCheckable(True)
        self._compare.setToolTip("Show the run selected above (A), or the one beside this button (B).")
        self._save = QPushButton("Save result…")
        self._save_motion = QPushButton("Save motion…")
        self._save_motion.setToolTip("Save the homographies of the frames as CSV or JSON.")
        self._remove = QPushButton("Remove")
        self._remove.setToolTip("Forget this run and take its layers out of the viewer.")
        self._continue = QPushButton("Continue for")
        self._more_steps = QSpinBox()
        self._lay_out()
        self._connect()
        self._follow()

    @property
    def run(self) -> KeptRun | None:
        """The run that is selected."""
        row = self._list.currentRow()
        return self._runs[row] if 0 <= row < len(self._runs) else None

    @property
    def runs(self) -> tuple[KeptRun, ...]:
        """All runs, oldest first."""
        return tuple(self._runs)

    def add(self, run: KeptRun) -> None:
        """Keep a run and select it."""
        # Nobody can tell the outlines of two runs apart, and all that is shown makes each drawing slower.
        for before in self._runs:
            before.layers.set_visible("frame", False)
        self._runs.append(run)
        item = QListWidgetItem(run.name)
        item.setFlags(item.flags() | Qt.ItemFlag.ItemIsEditable)
        self._list.addItem(item)
        self._list.setCurrentItem(item)
        self._follow()

    def refresh(self) -> None:
        """Show what has become of the run that is selected."""
        self._follow()

    def save_result(self, run: KeptRun, path: str | Path) -> None:
        """Write a run's picture and its provenance, or say why not."""
        if run.result is not None:
            _try(lambda: run.result.save(path), path)

    def save_homographies(self, run: KeptRun, path: str | Path) -> None:
        """Write a run's homographies as CSV or JSON, or say why not."""
        if run.result is not None:
            _try(lambda: write_homographies(path, run.result.homographies), path)

    def remove(self, run: KeptRun) -> None:
        """Forget a run and take its layers away."""
        self._compare.setChecked(False)
        row = self._runs.index(run)
        self._list.blockSignals(True)
        self._runs.remove(run)
        self._list.takeItem(row)
        self._list.blockSignals(False)
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
        rows = [
            (self._compare, self._other),
            (self._continue, self._more_steps),
            (self._save, self._save_motion, self._remove),
        ]
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self._list)
        layout.addWidget(self._summary)
        for widgets in rows:
            layout.addLayout(row_of(*widgets))

    def _connect(self) -> None:
        self._list.currentRowChanged.connect(self._take_choice)
        self._list.itemChanged.connect(self._rename)
        self._compare.toggled.connect(self._show_a_or_b)
        self._other.activated.connect(lambda _: self._show_a_or_b(self._compare.isChecked()))
        self._save.clicked.connect(self._ask_and_save)
        self._save_motion.clicked.connect(self._ask_and_save_motion)
        self._remove.clicked.connect(lambda: self.remove(self.run) if self.run is not None else None)
        self._continue.clicked.connect(lambda: self.continue_asked.emit(self.run, self._more_steps.value()))

    def _follow(self) -> None:
        """Offer what makes sense for the run that is selected."""
        run = self.run
        has_result = run is not None and run.result is not None
        self._summary.setText("" if run is None else run.summary)
        self._summary.setVisible(has_result)
        for button in (self._save, self._save_motion):
            button.setEnabled(has_result)
        self._remove.setEnabled(has_result or (run is not None and not self._is_running))
        others = [other for other in self._runs if other is not run]
        self._other.blockSignals(True)
        before = self._other.currentData()
        self._other.clear()
        for other in others:
            self._other.addItem(other.name, other)
        if before in others:
            self._other.setCurrentIndex(others.index(before))
        self._other.blockSignals(False)
        self._compare.setEnabled(bool(others))
        is_network = has_result and not isinstance(run.result.settings.method, SplineMethod)
        self._continue.setEnabled(is_network and not self._is_running)
        self._more_steps.setEnabled(is_network and not self._is_running)
        self._continue.setToolTip(
            "Go on from this result."
            if is_network or not has_result
            else "A spline is solved to its end, not trained: there is nothing to continue. Networks can go on."
        )

    def _take_choice(self) -> None:
        self._compare.setChecked(False)
        self._follow()
        self.chosen.emit(self.run)

    def _rename(self, item: QListWidgetItem) -> None:
        run, name = self._runs[self._list.row(item)], item.text().strip()
        if name and name != run.name:
            run.name = name
            run.layers.rename(name)
        elif not name:
            item.setText(run.name)
        self._follow()

    def _show_a_or_b(self, is_b: bool) -> None:
        """Show the picture of one run, A or B, and hide those of all others."""
        self._compare.setText("B / A" if is_b else "A / B")
        shown = self._other.currentData() if is_b else self.run
        for run in self._runs:
            run.layers.set_visible("picture", run is shown)

    def _ask_and_save(self) -> None:
        run = self.run
        path, _ = QFileDialog.getSaveFileName(
            self, "Save result", f"{run.name}.ome.tif", "OME-TIFF and JSON (*.ome.tif);;Representation (*.npz)"
        )
        if path:
            self.save_result(run, path)

    def _ask_and_save_motion(self) -> None:
        run = self.run
        path, _ = QFileDialog.getSaveFileName(
            self, "Save homographies", f"{run.name} homographies.csv", "CSV (*.csv);;JSON (*.json)"
        )
        if path:
            self.save_homographies(run, path)


def _try(write: Callable[[], object], path: str | Path) -> None:
    try:
        write()
    except FiberBurstError as error:
        show_error(str(error))
    else:
        show_info(f"wrote {path}")
