"""What is kept of each run: settings, result, time and layers; two of them side by side; and how they are saved."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari.utils.notifications import show_error, show_info
from qtpy.QtCore import Qt, Signal
from qtpy.QtWidgets import (
    QComboBox,
    QFileDialog,
    QListWidget,
    QListWidgetItem,
    QPushButton,
    QSpinBox,
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
    bundle : BundleSource or None
        The bundle that it was given; calibrated, where it was an image and the run has ended.
    source : BurstSource
        The burst.
    choices : dict
        What `reconstruct` was given by name.
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
        Once it has ended.
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
        """What came of it, line by line, but for the verdict."""
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
        return (*filter(None, lines), *(f"Note: {note}" for note in result.notes))

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
    """The list of runs, and what can be done with them."""

    chosen = Signal(object)  # KeptRun or None
    continue_asked = Signal(object, int)  # KeptRun, steps
    removed = Signal(object)  # KeptRun

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._runs: list[KeptRun] = []  # newest first, as they are listed
        self._is_running = False
        self.list_of_runs = QListWidget()
        self.list_of_runs.setMaximumHeight(_LINES_OF_RUNS * self.fontMetrics().height() + 16)
        self.list_of_runs.setToolTip("The runs so far, the newest first; double-click one to name it.")
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
        row = self.list_of_runs.currentRow()
        return self._runs[row] if 0 <= row < len(self._runs) else None

    @property
    def runs(self) -> tuple[KeptRun, ...]:
        """All runs, oldest first."""
        return tuple(reversed(self._runs))

    def add(self, run: KeptRun) -> None:
        """Keep a run, at the top of the list, and select it."""
        # Nobody can tell the outlines of two runs apart, and all that is shown makes each drawing slower.
        for before in self._runs:
            for kind in MOTION_KINDS:
                before.layers.switch(kind, False)
        self._runs.insert(0, run)
        item = QListWidgetItem(run.name)
        item.setFlags(item.flags() | Qt.ItemFlag.ItemIsEditable)
        self.list_of_runs.blockSignals(True)
        self.list_of_runs.insertItem(0, item)
        self.list_of_runs.blockSignals(False)
        self.list_of_runs.setCurrentItem(item)
        self.list_of_runs.scrollToItem(item)
        self._follow()

    def refresh(self) -> None:
        """Show what has become of the run that is selected."""
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
        row = self._runs.index(run)
        self.list_of_runs.blockSignals(True)
        self._runs.remove(run)
        self.list_of_runs.takeItem(row)
        self.list_of_runs.blockSignals(False)
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
            (self.compare_button, self.other),
            (self.continue_button, self._more_steps),
            (self.save_button, self.save_motion_button),
            (self.keep_button, self.remove_button),
        ]
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.list_of_runs)
        for widgets in rows:
            layout.addLayout(row_of(*widgets))

    def _connect(self) -> None:
        self.list_of_runs.currentRowChanged.connect(self._take_choice)
        self.list_of_runs.itemChanged.connect(self._rename)
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

    def _take_choice(self) -> None:
        self.compare_button.setChecked(False)
        self._follow()
        self.chosen.emit(self.run)

    def _rename(self, item: QListWidgetItem) -> None:
        run, name = self._runs[self.list_of_runs.row(item)], item.text().strip()
        if name and name != run.name:
            run.name = name
            run.layers.rename(name)
        elif not name:
            item.setText(run.name)
        self._follow()

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
