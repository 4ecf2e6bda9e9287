"""Buttons that save what a run has made: its image, its motion, its bundle."""

from collections.abc import Callable
from pathlib import Path

from napari.utils.notifications import show_error, show_info
from qtpy.QtWidgets import QFileDialog, QHBoxLayout, QPushButton, QWidget

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.io.results import write_homographies
from napari_fiberburst.plugin.kept_run import KeptRun


class SaveButtons(QWidget):
    """Ask where to, and write it, or say why not.

    Attributes
    ----------
    result, motion, bundle : QPushButton
        Locked where the run has nothing of the kind.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._run: KeptRun | None = None
        self.result, self.motion = QPushButton("Save result…"), QPushButton("Save motion…")
        self.bundle = QPushButton("Keep this bundle…")
        self.result.setToolTip("Save the image with its settings, or all that the run has, to be opened again.")
        self.motion.setToolTip("Save the homographies of the frames as CSV or JSON.")
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        for button, ask in (
            (self.result, self._ask_for_result),
            (self.motion, self._ask_for_motion),
            (self.bundle, self._ask_for_bundle),
        ):
            row.addWidget(button)
            button.clicked.connect(ask)

    def show_run(self, run: KeptRun | None) -> None:
        """Offer what there is to save of another run, or of what has become of this one."""
        self._run = run
        for button in (self.result, self.motion):
            button.setEnabled(run is not None and run.result is not None)
        self.bundle.setEnabled(run is not None and run.has_bundle)
        self.bundle.setToolTip(
            "Save the bundle that the run was given, improved by what the run has measured."
            if run is not None and run.bundle is not None
            else "Save the bundle that the run has found, for other bursts through the same probe."
        )

    def _ask_for_result(self) -> None:
        run = self._run
        if run is not None:
            kinds = "OME-TIFF and JSON (*.ome.tif);;Model, all that the run has (*.fiberburst);;Picture (*.png)"
            path = self._ask("Save result", f"{run.name}.ome.tif", kinds)
            if path:
                save_result(run, path)

    def _ask_for_motion(self) -> None:
        run = self._run
        if run is not None:
            path = self._ask("Save homographies", run.beside("homographies.csv"), "CSV (*.csv);;JSON (*.json)")
            if path:
                save_homographies(run, path)

    def _ask_for_bundle(self) -> None:
        run = self._run
        if run is not None:
            given = None if run.bundle is None else run.bundle.path
            path = self._ask("Keep bundle", given or f"{run.source.name}.bundle", "Bundle (*.bundle)")
            if path:
                keep_bundle(run, path)

    def _ask(self, title: str, suggested: str, kinds: str) -> str:
        """Return where the user wants a file; "" where nowhere."""
        path, _ = QFileDialog.getSaveFileName(self, title, suggested, kinds)
        return str(path)


def save_result(run: KeptRun, path: str | Path) -> None:
    """Write a run's image and its provenance, or say why not."""
    result = run.result
    if result is not None:
        _try(lambda: result.save(path), path)


def save_homographies(run: KeptRun, path: str | Path) -> None:
    """Write a run's homographies as CSV or JSON, or say why not."""
    result = run.result
    if result is not None:
        _try(lambda: write_homographies(path, result.homographies), path)


def keep_bundle(run: KeptRun, path: str | Path) -> None:
    """Write a run's bundle to a file, for other bursts through the same probe, or say why not."""
    _try(lambda: run.bundle_to_keep().save(path), path)


def _try(write: Callable[[], object], path: str | Path) -> None:
    try:
        write()
    except FiberBurstError as error:
        show_error(str(error))
    else:
        show_info(f"wrote {path}")
