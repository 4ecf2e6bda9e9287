"""Buttons that write the report or a figure of a run, and what has come of it."""

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from qtpy.QtCore import Qt, QUrl
from qtpy.QtWidgets import QFileDialog, QLabel, QPushButton, QVBoxLayout, QWidget
from superqt.utils import create_worker

from napari_fiberburst.plugin.problems import why
from napari_fiberburst.plugin.sections import row_of

if TYPE_CHECKING:
    from napari_fiberburst.plugin.kept_run import KeptRun

# Of a link, in both themes: Qt's own cannot be read on dark grey.
_LINK = "#3d85e0"


class ReportBox(QWidget):
    """Asks where to write the report or a figure of the run that is shown, writes it in another thread, and says where.

    Attributes
    ----------
    button, figure_button : QPushButton
        Locked while one of them is written, and where there is no result.
    words : QLabel
        Where the last one is, as a link that opens it; or why there is none.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._run: KeptRun | None = None
        self._writing: KeptRun | None = None
        self._what = "report"
        self.button, self.figure_button = QPushButton("Save report…"), QPushButton("Save figure…")
        self.words = QLabel()
        self.button.setToolTip("Write all that is known of this run on one page (HTML), which stands alone.")
        self.figure_button.setToolTip(
            "Write a captured frame beside the image, with scale bars and a caption, fit for a paper (SVG or PNG)."
        )
        self.words.setWordWrap(True)
        self.words.setTextInteractionFlags(Qt.TextInteractionFlag.TextBrowserInteraction)
        self.words.setOpenExternalLinks(True)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addLayout(row_of(self.button, self.figure_button))
        column.addWidget(self.words)
        self.button.clicked.connect(
            lambda: self._ask_and_write("report", write_report_of, "report.html", "Report (*.html)")
        )
        self.figure_button.clicked.connect(
            lambda: self._ask_and_write("figure", write_figure_of, "figure.svg", "SVG (*.svg);;PNG (*.png)")
        )
        self.show_run(None)

    def show_run(self, run: "KeptRun | None") -> None:
        """Let it be another run that is written of."""
        if run is not self._run:
            self._tell("")
        self._run = run
        has_result = run is not None and run.result is not None
        self.setVisible(has_result)
        for button in (self.button, self.figure_button):
            button.setEnabled(has_result and self._writing is None)

    def _ask_and_write(
        self, what: str, write: "Callable[[KeptRun, str | Path], Path]", ending: str, kinds: str
    ) -> None:
        """Ask for a place, and write there in another thread; then say where it is, or why there is nothing."""
        run = self._run
        if run is None:
            return
        path, _ = QFileDialog.getSaveFileName(self, f"Save {what}", run.beside(ending), kinds)
        if not path:
            return
        self._writing, self._what = run, what
        self.show_run(run)
        self._tell(f"Writing the {what}.")
        create_worker(
            write, run, path, _connect={"returned": self._take, "errored": self._take_error}, _ignore_errors=True
        )

    def _take(self, path: Path) -> None:
        link = QUrl.fromLocalFile(str(path.absolute())).toString(QUrl.ComponentFormattingOption.FullyEncoded)
        self._end(f'is in <a href="{escape(link)}" style="color: {_LINK}">{escape(str(path))}</a>')

    def _take_error(self, error: Exception) -> None:
        self._end(f"was not written: {escape(why(error, f'the {self._what} failed'))}")

    def _end(self, what_became: str) -> None:
        name = "" if self._writing is None else self._writing.name
        self._writing = None
        self.show_run(self._run)
        self._tell(f"The {self._what} of {escape(name)} {what_became}")

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


def write_figure_of(run: "KeptRun", path: str | Path) -> Path:
    """Write a figure of a run that has ended; reads its burst again, too.

    Raises
    ------
    FiberBurstError
        The burst cannot be read any more, or the file cannot be written.
    """
    from napari_fiberburst.report import check_figure, write_figure

    assert run.result is not None  # by whoever offers it
    check_figure(path)  # before the burst is read
    return write_figure(run.result, run.source.read(), path)


def _call_of(run: "KeptRun") -> str:
    """Return the call that repeats a run, and a remark on each thing that was changed while it ran."""
    turned = [f"# {name}={value!r} from {seconds:.1f} s on" for seconds, name, value in run.turned_live]
    return "\n".join([run.python.strip(), *turned])
