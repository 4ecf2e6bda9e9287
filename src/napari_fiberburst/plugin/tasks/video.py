"""Every frame of a long recording, sharp: it is shown as far as it is solved, kept on disk, and saved as a film."""

from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from qtpy.QtWidgets import QCheckBox, QPushButton, QSpinBox, QWidget

from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.plugin.bursts import guess_axes
from napari_fiberburst.plugin.film import ask_and_save
from napari_fiberburst.plugin.input_box import InputBox
from napari_fiberburst.plugin.tasks.long import LongTask

if TYPE_CHECKING:
    import napari

    from napari_fiberburst.recordings.video import Video
    from napari_fiberburst.recordings.work import Doing

# More frames than this behind each show nothing that moves.
_MOST_FRAMES = 999


class VideoTask(LongTask):
    """Reconstructs every frame of the recording that is chosen, by `napari_fiberburst.recordings.video`.

    Attributes
    ----------
    frames_behind : QSpinBox
        How many frames stand behind each; 0 as the motion asks for.
    stabilised : QCheckBox
        Whether the scene stands still.
    film_button : QPushButton
        Saves the video as a film, as it is shown.
    """

    title: ClassVar[str] = "Video"
    tip: ClassVar[str] = "Make every frame of a recording sharp, from those about it in time."
    kind: ClassVar[str] = "video"

    def __init__(self, viewer: "napari.viewer.Viewer", source: InputBox, parent: QWidget | None = None) -> None:
        super().__init__(viewer, source, parent)
        self.film_button.clicked.connect(self._ask_and_save)

    def begin(
        self, source: FrameSource, output: Path, bundle: Any, settings: dict[str, Any]
    ) -> "Generator[Doing, None, Video]":
        """Return the work; called in another thread."""
        from napari_fiberburst.recordings.video import videoing

        return videoing(source, output, bundle=bundle, regions=None, mp4=None, scale_bar=False, client=None, **settings)

    def settings(self) -> dict[str, Any]:
        """Return what is set."""
        return {
            **super().settings(),
            "window": self.frames_behind.value() or None,
            "stabilised": self.stabilised.isChecked(),
        }

    def more_rows(self) -> dict[str, QWidget]:
        """Return what a mosaic has no use for."""
        self.frames_behind, self.stabilised = QSpinBox(), QCheckBox("the scene stands still")
        self.frames_behind.setRange(0, _MOST_FRAMES)
        self.frames_behind.setSpecialValueText("auto")
        self.frames_behind.setAccessibleName("frames behind each")
        self.frames_behind.setToolTip(
            "How many frames in a row make one of the video: more are sharper, and show less of what changes; auto, as "
            "the motion asks for."
        )
        self.stabilised.setToolTip("Frames move over a scene that stands still; else they are shown as they lie.")
        return {"frames behind each": self.frames_behind, "stabilised": self.stabilised}

    def paths_of(self, result: "Video") -> tuple[Path, ...]:
        """Return the video."""
        return (result.path,)

    def lines_of(self, result: "Video") -> list[str]:
        """Return how many frames have a place, and what stands behind each."""
        placed, count = int((result.track.piece >= 0).sum()), len(result.track)
        return [
            f"{placed:,} of {count:,} frames have a place; {result.window} stand behind each.",
            f"The traces of all cores are in {result.traces.name}.",
        ]

    def card_widgets(self) -> tuple[QWidget, ...]:
        """Return what can be done with the video."""
        self.film_button = QPushButton("Save film…")
        self.film_button.setToolTip(
            "Save the video as a film, at the contrast of its layer, with a scale bar where the size of a pixel is "
            "known. Of any other layer with time: Save film… in the command palette."
        )
        return (self.film_button,)

    def _ask_and_save(self) -> None:
        for path in self._done:
            ask_and_save([self._shown[path].layer], guess_axes, self)
