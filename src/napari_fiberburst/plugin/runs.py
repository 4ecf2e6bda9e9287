"""What is kept of each run: settings, result, time and layers; two of them side by side; and how they are saved."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari.utils.notifications import show_error, show_info
from qtpy.QtCore import Qt, Signal
from qtpy.QtWidgets import (
    QComboBox,
    QFileDialog,
    QHeaderView,
    QPushButton,
    QSpinBox,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)

from napari_fiberburst.errors import BundleError, FiberBurstError
from napari_fiberburst.io.results import write_homographies
from napari_fiberburst.plugin.bundles import BundleSource
from napari_fiberburst.plugin.bursts import BurstSource
from napari_fiberburst.plugin.evidence import MOTION_KINDS
from napari_fiberburst.plugin.history import History
from napari_fiberburst.plugin.job import CurvePoint, Scores
from napari_fiberburst.plugin.layers import RunLayers
from napari_fiberburst.plugin.sections import row_of
from napari_fiberburst.settings import SplineMethod

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle
    from napari_fiberburst.results.reconstruction import Reconstruction

_LINES_OF_RUNS = 3
_MORE_STEPS = 200
_NARROWEST_COLUMN, _ABOVE_AND_BELOW = 30, 6
# What a row tells of a run, and in more words.
_COLUMNS = {
    "run": "Double-click to change it.",
    "method": "The preset, or the encoding of the scene.",
    "s": "Seconds that it took.",
    "verdict": "What the burst says of the image.",
    "error": "By how much samples that were left out are missed, intensity units.",
}


@dataclass(kw_only=True, eq=False)
class KeptRun:
    """One run: what it was asked, what came of it, and its layers.

    Attributes
    ----------
    name : str
        The user's to change.
    python : str
        The call, as lines of Python.
    bundle : BundleSource or None
        The bundle that it was given; calibrated, where it was an image and the run has ended.
    source : BurstSource
        The burst.
    choices : dict
        What `reconstruct` was given by name, or would be to come to the result as it was turned since.
    layers : RunLayers
        In the viewer.
    history : History
        The images on the way.
    curve : sequence of CurvePoint
        How it went; grows at its end while it runs.
    span : float
        The camera's full scale, which errors on the curves are parts of.
    turned_live : list of (float, str, object)
        Seconds, parameter and value of what was changed while it ran, which the call does not hold.
    result : Reconstruction or None
        Once it has ended, and while it is not being turned.
    scores : Scores or None
        The last ones, where the truth is known.
    """

    name: str
    python: str
    source: BurstSource
    choices: Mapping[str, Any]
    layers: RunLayers
    bundle: BundleSource | None = None
    history: History = field(default_factory=History)
    curve: Sequence[CurvePoint] = ()
    span: float = 1.0
    turned_live: list[tuple[float, str, Any]] = field(default_factory=list)
    result: "Reconstruction | None" = None
    scores: Scores | None = None

    @property
    def summary(self) -> tuple[str, ...]:
        """What came of it in numbers, line by line."""
        result = self.result
        if result is None:
            return ()
        seen = []
        if result.resolution is not None:
            size, unit = result.acquisition.pixel_size, result.acquisition.unit
            length = "" if size is None else f" = {result.resolution * sum(size) / 2:.3g} {unit}"
            seen.append(f"finest detail {result.resolution:.1f} px{length}")
        if result.frames_used is not None:
            seen.append(f"{len(result.frames_used)} of {len(result.homographies)} frames")
        ended = f"{result.ending} in {result.seconds:.1f} s on {result.device}"
        filled = "" if result.coverage is None else f"{(result.coverage == 0).mean():.1%} filled in · "
        lines = [" · ".join(seen), filled + ended]
        if self.scores is not None:
            scores = self.scores
            lines.append(
                f"against the truth: PSNR {scores.psnr:.1f} dB, SSIM {scores.ssim:.3f}, motion off by "
                f"{scores.motion_error:.2g} px"
            )
        return tuple(filter(None, lines))

    @property
    def row(self) -> tuple[str | float, ...]:
        """What is told of it in a table: name, method, seconds, verdict, and error of samples left out."""
        result = self.result
        named = str(self.choices.get("encoding", self.choices.get("preset", "")))
        if result is None:
            return self.name, named, "", "", ""
        method = named or str(result.settings.flat()["encoding"])
        error = "" if result.held_out_rmse is None else float(f"{result.held_out_rmse:.3g}")
        return self.name, method, round(result.seconds, 1), result.quality or "", error

    def note_turned(self, name: str, value: Any) -> None:
        """Note what was changed while it runs."""
        self.turned_live.append((self.curve[-1].seconds if self.curve else 0.0, name, value))
        self.layers.tell("turned_live", list(self.turned_live))

    @property
    def has_bundle(self) -> bool:
        """Whether there is a bundle to keep."""
        return self.result is not None and self.result.bundle is not None and self.result.bundle.is_resolved

    def bundle_to_keep(self) -> "Bundle":
        """Return the bundle that the run was given, improved by the run, or else the one that it has found.

        Raises
        ------
        BundleError
            There is none, or the run has measured nothing of it.
        """
        if self.result is None or self.result.bundle is None:
            raise BundleError(f"{self.name} has found no bundle; run with the preset auto, and let it end")
        given = None if self.bundle is None else self.bundle.bundle
        return self.result.bundle if given is None else given.updated(self.result)


class RunsPanel(QWidget):
    """The table of runs, and what can be done with them."""

    chosen = Signal(object)  # KeptRun or None
    continue_asked = Signal(object, int)  # KeptRun, steps
    removed = Signal(object)  # KeptRun

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._runs: list[KeptRun] = []  # newest first
        self._is_running = False
        self.table = QTableWidget(0, len(_COLUMNS))
        self.other = QComboBox()
        self.other.setToolTip("The run to compare with the one selected above.")
        self.compare_button = QPushButton("A / B")
        self.compare_button.setCheckable(True)
        self.compare_button.setToolTip("Show the run selected above (A), or the one beside this button (B).")
        self.save_button = QPushButton("Save result…")
        self.save_motion_button = QPushButton("Save motion…")
        self.save_motion_button.setToolTip("Save the homographies of the frames as CSV or JSON.")
        self.keep_button = QPushButton("Keep this bundle…")
        self.remove_button = QPushButton("Remove")
        self.remove_button.setToolTip("Forget this run and take its layers out of the viewer.")
        self.continue_button = QPushButton("Continue for")
        self._more_steps = QSpinBox()
        self._lay_out()
        self._connect()
        self._follow()

    @property
    def run(self) -> KeptRun | None:
        """The run that is selected."""
        item = self.table.item(self.table.currentRow(), 0)
        return None if item is None else item.data(Qt.ItemDataRole.UserRole)

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
        with self._quiet_table() as table:
            table.insertRow(0)
            for column in range(len(_COLUMNS)):
                item = QTableWidgetItem()
                item.setData(Qt.ItemDataRole.UserRole, run)
                if column > 0:
                    item.setFlags(item.flags() & ~Qt.ItemFlag.ItemIsEditable)
                table.setItem(0, column, item)
            self._fill(0, run)
        self.select(run)

    def select(self, run: KeptRun) -> None:
        """Select a run."""
        self.table.setCurrentCell(self._row(run), 0)

    def refresh(self) -> None:
        """Show what has become of the runs."""
        with self._quiet_table():
            for run in self._runs:
                self._fill(self._row(run), run)
        self._follow()

    def save_result(self, run: KeptRun, path: str | Path) -> None:
        """Write a run's image and its provenance, or say why not."""
        result = run.result
        if result is not None:
            _try(lambda: result.save(path), path)

    def save_homographies(self, run: KeptRun, path: str | Path) -> None:
        """Write a run's homographies as CSV or JSON, or say why not."""
        result = run.result
        if result is not None:
            _try(lambda: write_homographies(path, result.homographies), path)

    def keep_bundle(self, run: KeptRun, path: str | Path) -> None:
        """Write a run's bundle to a file, for other bursts through the same probe, or say why not."""
        _try(lambda: run.bundle_to_keep().save(path), path)

    def remove(self, run: KeptRun) -> None:
        """Forget a run and take its layers away."""
        self.compare_button.setChecked(False)
        with self._quiet_table() as table:
            table.removeRow(self._row(run))
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
        rows = [
            (self.compare_button, self.other, self.remove_button),
            (self.continue_button, self._more_steps),
            (self.save_button, self.save_motion_button, self.keep_button),
        ]
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        self._lay_out_table()
        layout.addWidget(self.table)
        for widgets in rows:
            layout.addLayout(row_of(*widgets))

    def _lay_out_table(self) -> None:
        table = self.table
        table.setHorizontalHeaderLabels(list(_COLUMNS))
        for column, tip in enumerate(_COLUMNS.values()):
            heading = table.horizontalHeaderItem(column)
            assert heading is not None  # its label has been set
            heading.setToolTip(tip)
        header, rows = table.horizontalHeader(), table.verticalHeader()
        assert header is not None  # every table has both
        assert rows is not None
        header.setMinimumSectionSize(_NARROWEST_COLUMN)
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        header.setSortIndicator(-1, Qt.SortOrder.AscendingOrder)
        rows.setVisible(False)
        rows.setDefaultSectionSize(self.fontMetrics().height() + _ABOVE_AND_BELOW)
        table.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
        table.setSelectionMode(QTableWidget.SelectionMode.SingleSelection)
        table.setSortingEnabled(True)
        table.setShowGrid(False)
        table.setFixedHeight((_LINES_OF_RUNS + 1) * (self.fontMetrics().height() + _ABOVE_AND_BELOW) + _ABOVE_AND_BELOW)
        table.setAccessibleName("runs")
        table.setToolTip("The runs so far, the newest first; press a heading to sort them by it.")

    def _connect(self) -> None:
        self.table.currentCellChanged.connect(self._take_choice)
        self.table.itemChanged.connect(self._rename)
        self.compare_button.toggled.connect(self._show_a_or_b)
        self.other.activated.connect(lambda _: self._show_a_or_b(self.compare_button.isChecked()))
        self.save_button.clicked.connect(self._ask_and_save)
        self.save_motion_button.clicked.connect(self._ask_and_save_motion)
        self.keep_button.clicked.connect(self._ask_and_keep)
        self.remove_button.clicked.connect(lambda: self.remove(self.run) if self.run is not None else None)
        self.continue_button.clicked.connect(lambda: self.continue_asked.emit(self.run, self._more_steps.value()))

    def _follow(self) -> None:
        """Offer what makes sense for the run that is selected."""
        run = self.run
        result = None if run is None else run.result
        has_result = result is not None
        for button in (self.save_button, self.save_motion_button):
            button.setEnabled(has_result)
        self.remove_button.setEnabled(has_result or (run is not None and not self._is_running))
        self.keep_button.setEnabled(run is not None and run.has_bundle)
        self.keep_button.setToolTip(
            "Save the bundle that the run was given, improved by what the run has measured."
            if run is not None and run.bundle is not None
            else "Save the bundle that the run has found, for other bursts through the same probe."
        )
        others = [other for other in self._runs if other is not run]
        self.other.blockSignals(True)
        before = self.other.currentData()
        self.other.clear()
        for other in others:
            self.other.addItem(other.name, other)
        if before in others:
            self.other.setCurrentIndex(others.index(before))
        self.other.blockSignals(False)
        self.compare_button.setEnabled(bool(others))
        is_network = result is not None and not isinstance(result.settings.method, SplineMethod)
        self.continue_button.setEnabled(is_network and not self._is_running)
        self._more_steps.setEnabled(is_network and not self._is_running)
        self.continue_button.setToolTip(
            "Go on from this result."
            if is_network or not has_result
            else "A spline is solved to its end, not trained: there is nothing to continue. Networks can go on."
        )

    def _row(self, run: KeptRun) -> int:
        """Return where a run stands, which the user can sort."""
        items = [self.table.item(row, 0) for row in range(self.table.rowCount())]
        return next(
            row for row, item in enumerate(items) if item is not None and item.data(Qt.ItemDataRole.UserRole) is run
        )

    @contextmanager
    def _quiet_table(self) -> Iterator[QTableWidget]:
        """Let the table be changed: no signals, and each row stays where it is until the end."""
        self.table.blockSignals(True)
        self.table.setSortingEnabled(False)
        yield self.table
        self.table.setSortingEnabled(True)
        self.table.blockSignals(False)

    def _fill(self, row: int, run: KeptRun) -> None:
        for column, value in enumerate(run.row):
            item = self.table.item(row, column)
            if item is not None:
                # As numbers, which are sorted as such.
                item.setData(Qt.ItemDataRole.DisplayRole, value)

    def _take_choice(self, row: int, column: int, row_before: int, column_before: int) -> None:
        if row == row_before:
            return
        self.compare_button.setChecked(False)
        self._follow()
        self.chosen.emit(self.run)

    def _rename(self, item: QTableWidgetItem) -> None:
        run, name = item.data(Qt.ItemDataRole.UserRole), item.text().strip()
        if name and name != run.name:
            run.name = name
            run.layers.rename(name)
        self.refresh()

    def _show_a_or_b(self, is_b: bool) -> None:
        """Show the image of one run, A or B, and hide those of all others."""
        self.compare_button.setText("B / A" if is_b else "A / B")
        shown = self.other.currentData() if is_b else self.run
        for run in self._runs:
            run.layers.set_visible("image", run is shown)

    def _ask_and_save(self) -> None:
        run = self.run
        if run is not None:
            path = self._ask(
                "Save result", f"{run.name}.ome.tif", "OME-TIFF and JSON (*.ome.tif);;Representation (*.npz)"
            )
            if path:
                self.save_result(run, path)

    def _ask_and_save_motion(self) -> None:
        run = self.run
        if run is not None:
            path = self._ask("Save homographies", f"{run.name} homographies.csv", "CSV (*.csv);;JSON (*.json)")
            if path:
                self.save_homographies(run, path)

    def _ask_and_keep(self) -> None:
        run = self.run
        if run is not None:
            given = None if run.bundle is None else run.bundle.path
            path = self._ask("Keep bundle", given or f"{run.source.name}.bundle", "Bundle (*.bundle)")
            if path:
                self.keep_bundle(run, path)

    def _ask(self, title: str, suggested: str, kinds: str) -> str:
        """Return where the user wants a file; "" where nowhere."""
        path, _ = QFileDialog.getSaveFileName(self, title, suggested, kinds)
        return str(path)


def _try(write: Callable[[], object], path: str | Path) -> None:
    try:
        write()
    except FiberBurstError as error:
        show_error(str(error))
    else:
        show_info(f"wrote {path}")
