"""One wide picture of a long recording: it grows on the screen, tile by tile, and is kept on disk."""

from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.plugin.tasks.long import LongTask

if TYPE_CHECKING:
    from napari_fiberburst.recordings.mosaic import Mosaic
    from napari_fiberburst.recordings.work import Doing


class MosaicTask(LongTask):
    """Makes a mosaic of the recording that is chosen, by `napari_fiberburst.recordings.mosaic`."""

    title: ClassVar[str] = "Mosaic"
    tip: ClassVar[str] = "Make one wide picture of all frames of a recording."
    kind: ClassVar[str] = "mosaic"
    further: ClassVar[dict[str, str]] = {
        "coverage": "How many core samples saw each pixel.",
        "uncertainty": "The standard deviation to be expected from noise and gaps, in intensity units.",
        "frames": "How many frames have looked at each pixel.",
    }

    def begin(
        self, source: FrameSource, output: Path, bundle: Any, settings: dict[str, Any]
    ) -> "Generator[Doing, None, Mosaic]":
        """Return the work; called in another thread."""
        from napari_fiberburst.recordings.mosaic import mosaicking

        return mosaicking(source, output, bundle=bundle, client=None, **settings)

    def paths_of(self, result: "Mosaic") -> tuple[Path, ...]:
        """Return one image a piece, the largest first."""
        return result.paths

    def lines_of(self, result: "Mosaic") -> list[str]:
        """Return how much has been placed, and how finely it is resolved."""
        placed, count, pieces = int((result.track.piece >= 0).sum()), len(result.track), result.track.pieces
        lines = [f"{placed:,} of {count:,} frames are placed, in {f'{pieces} pieces' if pieces > 1 else 'one piece'}."]
        if result.resolution is not None:
            lines.append(f"Finest detail {result.resolution:.1f} px.")
        return lines
