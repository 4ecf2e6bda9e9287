"""The table of runs: a row for each, with what came of it."""

from collections.abc import Iterator
from contextlib import contextmanager

from qtpy.QtCore import QItemSelectionModel, QSize, Qt, Signal
from qtpy.QtWidgets import QHeaderView, QTableWidget, QTableWidgetItem, QWidget

from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.thumbnails import icon_of

_MOST_LINES, _ICON = 3, 20
_WHOLE_ROWS = QItemSelectionModel.SelectionFlag.Rows
_NARROWEST_COLUMN, _ABOVE_AND_BELOW = 30, 6
# What a row tells of a run, and in more words.
_COLUMNS = {
    "run": "Double-click to change it.",
    "method": "The preset, or the encoding of the scene.",
    "s": "Seconds that it took.",
    "verdict": "What the burst says of the image.",
    "error": "By how much samples that were left out are missed, intensity units.",
}


class RunsTable(QTableWidget):
    """Shows runs, the newest first until the user sorts them, and lets them be selected and renamed."""

    chosen = Signal()  # another run is the current one, or none is
    marked = Signal()  # other runs are selected
    renamed = Signal(object, str)  # KeptRun, what the user has typed

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(0, len(_COLUMNS), parent)
        self.setAccessibleName("runs")
        self.setToolTip(
            "The runs so far, the newest first; press a heading to sort them by it.\n"
            "With Ctrl or Shift, several are selected: their curves are drawn together."
        )
        self._lay_out()
        self.currentCellChanged.connect(lambda row, _, before, __: self.chosen.emit() if row != before else None)
        self.itemSelectionChanged.connect(self.marked)
        self.itemChanged.connect(self._rename)

    @property
    def run(self) -> KeptRun | None:
        """The current run."""
        return self._run_of(self.currentRow())

    @property
    def selected(self) -> list[KeptRun]:
        """All runs that are selected, from top to bottom; the current one, where none is."""
        model = self.selectionModel()
        rows = [] if model is None else sorted(index.row() for index in model.selectedRows())
        return [run for row in rows or [self.currentRow()] if (run := self._run_of(row)) is not None]

    def add(self, run: KeptRun, row: int = 0) -> None:
        """Show a run in a row, the first one or another, and select it."""
        with self._quiet():
            self.insertRow(row)
            for column in range(len(_COLUMNS)):
                item = QTableWidgetItem()
                item.setData(Qt.ItemDataRole.UserRole, run)
                if column > 0:
                    item.setFlags(item.flags() & ~Qt.ItemFlag.ItemIsEditable)
                self.setItem(row, column, item)
            self._fill(row, run)
        self._fit_height()
        self.select(run)

    def select(self, run: KeptRun) -> None:
        """Select a run alone."""
        self.setCurrentCell(self._row_of(run), 0, QItemSelectionModel.SelectionFlag.ClearAndSelect | _WHOLE_ROWS)

    def step(self, by: int) -> None:
        """Select the run that is so many rows further down, as far as there is one."""
        run = self._run_of(min(max(self.currentRow() + by, 0), self.rowCount() - 1))
        if run is not None:
            self.select(run)

    def take_out(self, run: KeptRun) -> None:
        """Show a run no more; says nothing of which is the current one then."""
        with self._quiet():
            self.removeRow(self._row_of(run))
        self._fit_height()

    def refresh(self) -> None:
        """Show what has become of the runs."""
        with self._quiet():
            for row in range(self.rowCount()):
                run = self._run_of(row)
                if run is not None:
                    self._fill(row, run)

    def _lay_out(self) -> None:
        self.setHorizontalHeaderLabels(list(_COLUMNS))
        for column, tip in enumerate(_COLUMNS.values()):
            heading = self.horizontalHeaderItem(column)
            assert heading is not None  # its label has been set
            heading.setToolTip(tip)
        header, rows = self.horizontalHeader(), self.verticalHeader()
        assert header is not None  # every table has both
        assert rows is not None
        header.setMinimumSectionSize(_NARROWEST_COLUMN)
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        header.setSortIndicator(-1, Qt.SortOrder.AscendingOrder)
        rows.setVisible(False)
        rows.setDefaultSectionSize(_ICON + 1)
        self.setIconSize(QSize(_ICON, _ICON))
        self.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
        self.setSelectionMode(QTableWidget.SelectionMode.ExtendedSelection)
        self.setSortingEnabled(True)
        self.setShowGrid(False)
        self._fit_height()

    def _fit_height(self) -> None:
        """Take no more room than there are runs, as far as it goes."""
        lines = min(max(self.rowCount(), 1), _MOST_LINES)
        self.setFixedHeight(lines * (_ICON + 1) + self.fontMetrics().height() + 2 * _ABOVE_AND_BELOW)

    def _run_of(self, row: int) -> KeptRun | None:
        item = self.item(row, 0)
        return None if item is None else item.data(Qt.ItemDataRole.UserRole)

    def _row_of(self, run: KeptRun) -> int:
        """Return where a run stands, which the user can sort."""
        return next(row for row in range(self.rowCount()) if self._run_of(row) is run)

    @contextmanager
    def _quiet(self) -> Iterator[None]:
        """Let rows be changed: no signals, and each row stays where it is until the end."""
        self.blockSignals(True)
        self.setSortingEnabled(False)
        yield
        self.setSortingEnabled(True)
        self.blockSignals(False)

    def _fill(self, row: int, run: KeptRun) -> None:
        for column, value in enumerate(run.row):
            item = self.item(row, column)
            if item is not None:
                # As numbers, which are sorted as such.
                item.setData(Qt.ItemDataRole.DisplayRole, value)
        first = self.item(row, 0)
        if first is not None and first.icon().isNull() and run.result is not None:
            first.setIcon(icon_of(run.result.image, _ICON))

    def _rename(self, item: QTableWidgetItem) -> None:
        self.renamed.emit(item.data(Qt.ItemDataRole.UserRole), item.text().strip())
