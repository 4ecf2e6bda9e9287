"""The card of a run: what came of it, and switches for all that its image rests on."""

from html import escape
from typing import Any

from napari.components import ViewerModel
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QCheckBox, QGridLayout, QLabel, QVBoxLayout, QWidget

from napari_fiberburst.plugin.evidence import KINDS
from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.reporting import ReportBox
from napari_fiberburst.plugin.sections import order_tabs
from napari_fiberburst.plugin.steering import SteeringBox

_COLUMNS, _SPACING = 2, 3
_PENDING = "Shown as it will be. It is judged anew once nothing is turned any more."
# Of a verdict; they are told apart by their words too.
_COLOURS = {"good": "#3fa34d", "doubtful": "#d9822b", "bad": "#d64545"}
_MEANING = {
    "good": "the burst says nothing against the image",
    "doubtful": "worse than such a burst should give",
    "bad": "the image does not show the object",
}


class ResultCard(QWidget):
    """Shows verdict, numbers and notes of the run that is selected; each switch makes a layer, or takes it away.

    Parameters
    ----------
    viewer : ViewerModel
        Whose layers to follow: one that a user deletes is switched off.

    Attributes
    ----------
    words, notes : QLabel
        What came of the run, and what to know before trusting it.
    switches : dict of str to QCheckBox
        By what they show.
    steering : SteeringBox
        Solves the run's scene again, smoother or from other frames.
    report : ReportBox
        Writes all of it on a page.
    """

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._run: KeptRun | None = None
        self.words, self.notes = QLabel(), QLabel()
        for label in (self.words, self.notes):
            label.setWordWrap(True)
            label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.switches = {kind: QCheckBox(kind) for kind in KINDS}
        self.steering, self.report = SteeringBox(viewer), ReportBox()
        layout, self._grid = QVBoxLayout(self), QGridLayout()
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(_SPACING)
        layout.addWidget(self.words)
        layout.addWidget(self.steering)
        layout.addLayout(self._grid)
        layout.addWidget(self.notes)
        layout.addWidget(self.report)
        for kind, switch in self.switches.items():
            switch.setToolTip(KINDS[kind])
            switch.toggled.connect(lambda on, kind=kind: self._switch(kind, on))
        self.steering.changed.connect(self.refresh)
        self.open()
        self.show_run(None)

    def open(self) -> None:
        """Follow the viewer's layers, again where it was closed."""
        self._viewer.layers.events.removed.connect(self.refresh)
        self.steering.open()

    def shut(self) -> None:
        """Follow the viewer no more. May be called more than once."""
        self._viewer.layers.events.removed.disconnect(self.refresh)
        self.steering.shut()

    def show_run(self, run: KeptRun | None) -> None:
        """Show another run."""
        self._run = run
        self.steering.show_run(run)
        self.refresh()

    def refresh(self, event: Any = None) -> None:
        """Show what has become of the run."""
        self.steering.refresh()
        run = self._run
        kinds = () if run is None else run.layers.kinds
        for kind, switch in self.switches.items():
            switch.blockSignals(True)
            switch.setChecked(run is not None and run.layers.is_on(kind))
            switch.blockSignals(False)
        offered = [kind for kind in KINDS if kind in kinds]
        is_pending = self.steering.is_pending
        for kind in KINDS:
            self.switches[kind].setEnabled(not is_pending or kind in kinds)
        # Nothing moves under the hand of somebody who turns the scene: what is gone for now keeps its room.
        if not is_pending and offered != [kind for kind, switch in self.switches.items() if not switch.isHidden()]:
            self._offer(offered)
        if not is_pending:
            self.words.setMinimumHeight(0)
        elif self.words.minimumHeight() == 0:
            self.words.setMinimumHeight(self.words.heightForWidth(self.words.width()))
        self.words.setText(_PENDING if is_pending else "" if run is None else _in_words(run))
        notes = () if run is None or run.result is None else run.result.notes
        self.notes.setText("<br>".join(f"Note: {escape(note)}" for note in notes))
        for label in (self.words, self.notes):
            label.setVisible(bool(label.text()))
        self.report.show_run(run)
        self.setVisible(bool(offered) or is_pending)

    def _offer(self, kinds: list[str]) -> None:
        for switch in self.switches.values():
            self._grid.removeWidget(switch)
            switch.setVisible(False)
        for number, kind in enumerate(kinds):
            self._grid.addWidget(self.switches[kind], *divmod(number, _COLUMNS))
            self.switches[kind].setVisible(True)
        order_tabs(self)

    def _switch(self, kind: str, on: bool) -> None:
        if self._run is not None:
            self._run.layers.switch(kind, on)


def _in_words(run: KeptRun) -> str:
    """Return the verdict as a coloured word, and below it what else there is to say, for a label that knows HTML."""
    if run.result is None:
        return ""
    quality = run.result.quality
    verdict = "" if quality is None else f'<b style="color: {_COLOURS[quality]}">{quality}</b>: {_MEANING[quality]}<br>'
    return verdict + "<br>".join(escape(line) for line in run.summary)
