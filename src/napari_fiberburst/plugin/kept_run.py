"""What is kept of one run: settings, result, time and layers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_fiberburst.errors import BundleError
from napari_fiberburst.plugin.bundles import BundleSource
from napari_fiberburst.plugin.bursts import BurstSource
from napari_fiberburst.plugin.history import History
from napari_fiberburst.plugin.job import CurvePoint, Scores
from napari_fiberburst.plugin.layers import RunLayers

if TYPE_CHECKING:
    from napari_fiberburst.bundle.bundle import Bundle
    from napari_fiberburst.results.reconstruction import Reconstruction


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

    def beside(self, ending: str) -> str:
        """Return a place for what is written of it, called by its name: where its burst lies, if that is a file."""
        name = f"{self.name} {ending}"
        return name if self.source.path is None else str(Path(self.source.path).absolute().parent / name)

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
