"""What tasks on whole recordings have in common: work in another thread, in units that are kept, shown as it grows."""

import atexit
from abc import abstractmethod
from collections.abc import Callable, Generator
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from napari.utils.notifications import show_error
from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import QCheckBox, QComboBox, QHBoxLayout, QLabel, QProgressBar, QPushButton, QVBoxLayout, QWidget
from superqt.utils import create_worker

from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import BurstError, FiberBurstError
from napari_fiberburst.plugin import METADATA_KEY, RECORDING_KEY
from napari_fiberburst.plugin.bundles import BundleSource
from napari_fiberburst.plugin.input_box import InputBox
from napari_fiberburst.plugin.long_job import LongJob, in_words
from napari_fiberburst.plugin.output_row import OutputRow, near, stem_of, work_of
from napari_fiberburst.plugin.placement import Placement
from napari_fiberburst.plugin.recordings import recording_in, recording_told, reopened
from napari_fiberburst.plugin.sections import form_layout, row_of
from napari_fiberburst.plugin.tasks.task import Task

if TYPE_CHECKING:
    import napari

    from napari_fiberburst.plugin.pyramids import PyramidLayer
    from napari_fiberburst.recordings.work import Doing

State = Literal["ready", "running", "paused", "stopping"]
_MILLISECONDS, _PARTS = 100, 1000
_MOTIONS = {"as the frames ask for": None, "shifts": 2, "shifts, turns and zoom": 4}
# What is being written by a dock of this process: two must not work in one folder.
_WRITTEN: set[Path] = set()


class LongTask(Task):
    """Works on the whole recording that is chosen, in another thread, and writes what comes of it beside it.

    Attributes
    ----------
    kind : str
        What is made: "mosaic" or "video".
    output : OutputRow
        Where that is written.
    motion : QComboBox
        How frames may lie.
    pause_button, stop_button : QPushButton
        Hold the work, and end it in such a way that it can be gone on with.
    status, words : QLabel
        What is being done, and what has come of it.
    switches : dict of str to QCheckBox
        What else can be shown of the result.
    state : str
        "ready", "running", "paused" or "stopping".
    told_of : (FrameSource, Placement, Path) or None
        What was last begun on, where its frames lie in the viewer, and where it is written.
    """

    kind: ClassVar[str]
    needs_burst: ClassVar[bool] = False
    further: ClassVar[dict[str, str]] = {}  # what is written beside each picture, and what it shows

    def __init__(self, viewer: "napari.viewer.Viewer", source: InputBox, parent: QWidget | None = None) -> None:
        super().__init__(viewer, source, parent)
        self.state: State = "ready"
        self._going: list[LongJob] = []  # none, or the one that is
        self.told_of: tuple[FrameSource, Placement, Path] | None = None
        self._shown: dict[Path, PyramidLayer] = {}
        self._done: tuple[Path, ...] = ()
        self.output, self.motion = OutputRow(self.kind), QComboBox()
        self.pause_button, self.stop_button = QPushButton("Pause"), QPushButton("Stop")
        self.bar, self.status, self.words = QProgressBar(), QLabel(), QLabel()
        self.switches = {name: QCheckBox(name) for name in self.further}
        self._timer = QTimer(self)
        self._timer.setInterval(_MILLISECONDS)
        self._lay_out()
        self._connect()
        self._follow_state("ready")
        self._take_input()

    @abstractmethod
    def begin(
        self, source: FrameSource, output: Path, bundle: Any, settings: dict[str, Any]
    ) -> "Generator[Doing, None, Any]":
        """Return the work; called in another thread."""

    @abstractmethod
    def paths_of(self, result: Any) -> tuple[Path, ...]:
        """Return the images or videos that a result lies in."""

    @abstractmethod
    def lines_of(self, result: Any) -> list[str]:
        """Return what has come of the work, a line each."""

    def settings(self) -> dict[str, Any]:
        """Return what is set."""
        return {"dof": self.motion.currentData()}

    def more_rows(self) -> dict[str, QWidget]:
        """Return new widgets of settings of this task alone, by their names."""
        return {}

    def card_widgets(self) -> tuple[QWidget, ...]:
        """Return new widgets of what can be done with a result; they are shown once there is one."""
        return ()

    @property
    def job(self) -> LongJob | None:
        """The work that is going."""
        return self._going[0] if self._going else None

    @property
    def is_empty(self) -> bool:
        """Whether nothing is being made, and nothing has been."""
        return self.job is None and not self.words.text()

    def start(self) -> None:
        """Begin, or go on where the work was stopped. Does nothing while it goes."""
        if self.job is not None:
            return
        path = self.output.path
        try:
            self._refuse(path)
            burst, given = self.input.recorded(), self.input.bundle_source()
            source = recording_in(burst)
        except FiberBurstError as error:
            self._say_problem(str(error))
            return
        self._forget(path)
        self.told_of = (source, Placement.of(self.input.layers, burst.axes, (0, 0)), path)
        opened_from = self.input.layers[0].metadata.get(METADATA_KEY, {}).get("recording_path")
        job = LongJob(partial(_begun, self.begin, source, opened_from, path, given, self.settings()))
        self._going.append(job)
        _WRITTEN.add(path)
        atexit.register(job.control.stop)
        self.words.clear()
        self._show_card()
        self.bar.setValue(0)
        self.status.setText("starting")
        self._follow_state("running")
        create_worker(_run, job, path, _connect={"finished": partial(self._end, job)})
        self._timer.start()
        self.kept_changed.emit()

    def pause(self) -> None:
        """Hold the work before its next step, or go on."""
        if self.job is not None and self.state == "running":
            self.job.control.pause()
            self._follow_state("paused")
        elif self.job is not None and self.state == "paused":
            self.job.control.resume()
            self._follow_state("running")

    def stop(self) -> None:
        """End the work after the step it is in; what is done is kept."""
        if self.job is not None and self.state in ("running", "paused"):
            self.job.control.stop()
            self._follow_state("stopping")

    def shut_down(self) -> None:
        """Stop what is running and let go of it. May be called more than once."""
        self._timer.stop()
        if self._going:
            _let_go(self._going)
            self._follow_state("ready")

    def _refuse(self, path: Path) -> None:
        """Refuse what cannot be done, before any work.

        Raises
        ------
        BurstError
            Says why, in one sentence; where the place is taken, another name is suggested.
        """
        if self.input.region.value is not None:
            raise BurstError(f"a {self.kind} is made of whole frames; choose no region")
        beside = near(self.input.layers[0]) if self.input.layers else path
        if path in _WRITTEN:
            self.output.suggest_free(beside, but_not=_WRITTEN)
            raise BurstError(f"{path} is being written just now; another name is suggested, or wait for its end")
        if path.exists() and not work_of(path).exists():
            self.output.suggest_free(beside, but_not=_WRITTEN)
            raise BurstError(f"{path} is there already; another name is suggested, or choose one")

    def _end(self, job: LongJob) -> None:
        atexit.unregister(job.control.stop)
        if job is not self.job or self.told_of is None:
            return  # the dock has been closed
        path = self.told_of[2]
        self._timer.stop()
        self._look()
        self._going.clear()
        if job.result is not None:
            self._done = self.paths_of(job.result)
            lines = [*self.lines_of(job.result), _time_in_words(job.seconds), f"It lies in {path}."]
            notes = [f"Note: {note}" for note in job.result.notes]
            self.words.setText("<br>".join(map(escape, [*lines, *notes])))
            self.status.setText(f"The {self.kind} is finished.")
            for one in self._done:
                self._show_path(one)
        elif job.problem:
            self._say_problem(job.problem)
        else:
            self.status.setText(f"Stopped. What is done is kept in {work_of(path).name}; Start goes on from there.")
        self._follow_state("ready")
        self._show_card()
        self.kept_changed.emit()

    def _look(self) -> None:
        """Show what is new."""
        job = self.job
        if job is None:
            return
        doing = job.doing.take()
        if doing is not None:
            self.bar.setValue(round(_PARTS * doing.part))
            self.status.setText(in_words(doing))
        grown = set()
        while job.grown:
            grown.add(job.grown.popleft())
        for path in grown:
            self._show_path(path)

    def _show_path(self, path: Path, what: str = "") -> None:
        """Show an image that lies on disk, or what has been added to it since."""
        from napari_fiberburst.plugin.pyramids import PyramidLayer  # needs zarr, an extra

        if self.told_of is None:
            return
        source, placement, _ = self.told_of
        known = self._shown.get(path)
        if known is not None:
            if known.layer in self._viewer.layers:
                known.refresh()
            return
        name = f"{stem_of(path.parent if what else path).name}{f': {what}' if what else ''}"
        told = {"run": name, "recording_path": str(path), RECORDING_KEY: recording_told(source.acquisition)}
        made = PyramidLayer(path, name, placement, source.acquisition, {METADATA_KEY: told})
        self._shown[path] = made
        chosen = set(self._viewer.layers.selection)
        self._viewer.add_layer(made.layer)
        self._viewer.layers.selection = chosen or {made.layer}
        if not what:
            self._viewer.reset_view()  # it is larger than the frames

    def _switch(self, name: str, on: bool) -> None:
        """Show something else of the result, or take it away."""
        for path in (one / name for one in self._done):
            shown = self._shown.pop(path, None)
            if shown is not None and shown.layer in self._viewer.layers:
                self._viewer.layers.remove(shown.layer)
            if on:
                self._show_path(path, name)

    def _forget(self, path: Path) -> None:
        """Let go of the layers of another output; they stay in the viewer."""
        self._done = ()
        is_same = self.told_of is not None and self.told_of[2] == path
        self._shown = {
            one: shown for one, shown in self._shown.items() if is_same and shown.layer in self._viewer.layers
        }

    def _say_problem(self, problem: str) -> None:
        self.status.setText(problem)
        show_error(problem)

    def _take_input(self) -> None:
        """Suggest where to write, and say what can be done with what is chosen now."""
        if self.job is not None:
            return
        if self.input.burst.value is not None:
            self.output.suggest(near(self.input.burst.value))
        self._tell_what_is_there()
        self._follow_state("ready")

    def _tell_what_is_there(self) -> None:
        if self.job is not None or not self.is_empty:
            return
        is_begun = self.input.burst.value is not None and work_of(self.output.path).exists()
        self.status.setText("Work was begun here before: Start goes on where it was stopped." if is_begun else self.tip)

    def _follow_state(self, state: State) -> None:
        """Offer what can be done now."""
        self.state = state
        is_ready = state == "ready"
        self.start_button.setEnabled(is_ready and self.input.burst.value is not None)
        self.pause_button.setEnabled(state in ("running", "paused"))
        self.pause_button.setText("Continue" if state == "paused" else "Pause")
        self.stop_button.setEnabled(state in ("running", "paused"))
        self.form.setEnabled(is_ready)
        self.bar.setVisible(not is_ready)
        if state in ("paused", "stopping"):
            self.status.setText("paused" if state == "paused" else "stopping; what is done is kept")

    def _show_card(self) -> None:
        for name, switch in self.switches.items():
            switch.blockSignals(True)
            switch.setChecked(any(one / name in self._shown for one in self._done))
            switch.blockSignals(False)
        for widget in (*self.switches.values(), *self._of_result):
            widget.setVisible(bool(self._done))
            widget.setEnabled(bool(self._done))
        self.words.setVisible(bool(self.words.text()))

    def _connect(self) -> None:
        self.start_button.clicked.connect(lambda: self.start())
        self.pause_button.clicked.connect(self.pause)
        self.stop_button.clicked.connect(self.stop)
        self.input.changed.connect(self._take_input)
        self.output.changed.connect(self._tell_what_is_there)
        self._timer.timeout.connect(self._look)
        for name, switch in self.switches.items():
            switch.toggled.connect(partial(self._switch, name))
        # The window can go without a word to this widget; what is called then must not need it.
        self.destroyed.connect(partial(_let_go, self._going))

    def _lay_out(self) -> None:
        self.start_button.setToolTip(f"Make the {self.kind}, or go on where the work was stopped.")
        self.pause_button.setToolTip("Hold the work where it is.")
        self.stop_button.setToolTip("End the work; what is done is kept, and Start goes on from there.")
        self.motion.setAccessibleName(f"motion of the {self.kind}")
        self.motion.setToolTip("How frames may lie: shifted alone, or turned and grown as well.")
        for words, dof in _MOTIONS.items():
            self.motion.addItem(words, dof)
        self.form = QWidget()
        rows = form_layout()
        self.form.setLayout(rows)
        for name, row in {"write to": self.output, "motion": self.motion, **self.more_rows()}.items():
            rows.addRow(name, row)
        for label in (self.status, self.words):
            label.setWordWrap(True)
            label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.status.setTextFormat(Qt.TextFormat.PlainText)
        self.bar.setRange(0, _PARTS)
        self.bar.setTextVisible(False)
        switches = QHBoxLayout()
        for name, switch in self.switches.items():
            switch.setToolTip(self.further[name])
            switches.addWidget(switch)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.form)
        column.addLayout(row_of(self.start_button, self.pause_button, self.stop_button))
        for told in (self.bar, self.status, self.words):
            column.addWidget(told)
        column.addLayout(switches)
        self._of_result = self.card_widgets()
        for widget in self._of_result:
            column.addWidget(widget)
        self._show_card()


def _begun(
    begin: "Callable[..., Generator[Doing, None, Any]]",
    source: FrameSource,
    opened_from: Any,
    output: Path,
    given: BundleSource | None,
    settings: dict[str, Any],
) -> "Generator[Doing, None, Any]":
    """Begin the work on a recording, which must be what it was when it was opened."""
    from napari_fiberburst.pipeline.reconstruct import as_bundle  # torch takes seconds to load

    bundle = None if given is None else as_bundle(given.given)
    return begin(reopened(source, opened_from), output, bundle, settings)


def _run(job: LongJob, output: Path) -> None:
    try:
        job.run()
    finally:
        _WRITTEN.discard(output)


def _let_go(going: list[LongJob], *_: Any) -> None:
    for job in going:
        job.control.stop()
    going.clear()


def _time_in_words(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"It took {f'{minutes} min {rest} s' if minutes else f'{rest} s'}."
