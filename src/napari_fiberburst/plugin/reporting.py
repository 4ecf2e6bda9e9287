"""A button that writes the report of a run, and what has come of it."""

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from qtpy.QtCore import Qt, QUrl
from qtpy.QtWidgets import QFileDialog, QLabel, QPushButton, QVBoxLayout, QWidget
from superqt.utils import create_worker

from napari_fiberburst.plugin.problems import why

if TYPE_CHECKING:
    from napari_fiberburst.plugin.kept_run import KeptRun

# Of a link, in both themes: Qt's own cannot be read on dark grey.
_LINK = "#3d85e0"


class ReportBox(QWidget):
    """Asks where to write the report of the run that is shown, writes it in another thread, and says where it is.

    Attributes
    ----------
    button : QPushButton
        Locked while a report is written.
    words : QLabel
        Where the last report is, as a link that opens it; or why there is none.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._run: KeptRun | None = None
        self._writing: KeptRun | None = None
        self.button, self.words = QPushButton("Save report…"), QLabel()
        self.button.setToolTip("Write all that is known of this run on one page (HTML), which stands alone.")
        self.words.setWordWrap(True)
        self.words.setTextInteractionFlags(Qt.TextInteractionFlag.TextBrowserInteraction)
        self.words.setOpenExternalLinks(True)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.button)
        column.addWidget(self.words)
        self.button.clicked.connect(self._ask_and_write)
        self.show_run(None)

    def show_run(self, run: "KeptRun | None") -> None:
        """Let it be another run's report."""
        if run is not self._run:
            self._tell("")
        self._run = run
        self.setVisible(run is not None and run.result is not None)
        self.button.setEnabled(self._writing is None)

    def write(self, run: "KeptRun", path: str | Path) -> None:
        """Write a run's report in another thread; then say where it is, or why there is none."""
        self._writing = run
        self.show_run(self._run)
        self._tell("Writing the report.")
        create_worker(
            write_report_of,
            run,
            path,
            _connect={"returned": self._take, "errored": self._take_error},
            _ignore_errors=True,
        )

    def _ask_and_write(self) -> None:
        run = self._run
        if run is not None:
            path, _ = QFileDialog.getSaveFileName(self, "Save report", f"{run.name} report.html", "Report (*.html)")
            if path:
                self.write(run, path)

    def _take(self, path: Path) -> None:
        link = QUrl.fromLocalFile(str(path.absolute())).toString(QUrl.ComponentFormattingOption.FullyEncoded)
        self._end(f'is in <a href="{escape(link)}" style="color: {_LINK}">{escape(str(path))}</a>')

    def _take_error(self, error: Exception) -> None:
        self._end(f"was not written: {escape(why(error, 'the report failed'))}")

    def _end(self, what_became: str) -> None:
        name = "" if self._writing is None else self._writing.name
        self._writing = None
        self.show_run(self._run)
        self._tell(f"The report of {escape(name)} {what_became}")

    def _tell(self, words: str) -> None:
        self.words.setText(words)
        self.words.setVisible(bool(words))


def write_report_of(run: "KeptRun", path: str | Path) -> Path:
    """Write the report of a run that has ended; reads its burst again, which may take as long as reading the file does.

    Raises
    ------
    FiberBurstError
        The burst cannot be read any more, or the file cannot be written.
    """
    from napari_fiberburst.report import check_report, write_report

    assert run.result is not None  # by whoever offers it
    check_report(path)  # before the burst is read
    return write_report(run.result, run.source.read(), path, name=run.source.name, call=_call_of(run))


def _call_of(run: "KeptRun") -> str:
    """Return the call that repeats a run, and a remark on each thing that was changed while it ran."""
    turned = [f"# {name}={value!r} from {seconds:.1f} s on" for seconds, name, value in run.turned_live]
    return "\n".join([run.python.strip(), *turned])
