"""What an image rests on: what was measured, how well, and what was filled in."""

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.quality.resolution import RingCorrelation

Quality = Literal["good", "doubtful", "bad"]
Ending = Literal["finished", "stopped", "time budget", "diverged"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Diagnostics:
    """What is known of a reconstruction beside its image; None where the method does not tell.

    Attributes
    ----------
    coverage : numpy.ndarray or None
        (H, W) float32 on the canvas: how many core samples have seen each pixel; 0 where the image is filled in
        from its surroundings.
    context : numpy.ndarray or None
        (H, W) int32 on the canvas: how many frames have a sample whose footprint, or pixel, covers the centre of each
        pixel; samples that were left out do not count.
    uncertainty : numpy.ndarray or None
        (H, W) float32 on the canvas, the standard deviation to be expected of the image, intensity units, averaged
        over the channels. It holds what noise and gaps do, not what a wrong model does.
    bundle : Bundle or None
        The bundle as this burst shows it: where it is in these frames, with gains as they were taken out. It can be
        kept, and serves other bursts through the same probe.
    gain_ratios : numpy.ndarray or None
        (N,) float32, the gain of each core as the finished scene shows it, relative to the bundle's; 1 where nothing
        was seen. `Bundle.updated` takes it in.
    gain_weights : numpy.ndarray or None
        (N,) float32, how much light each of these ratios rests on: squares of full scale, added over frames.
    residuals : numpy.ndarray or None
        (T, N) float32, root mean square by which the model misses each core in each frame, intensity units; NaN
        where there is no sample.
    outliers : numpy.ndarray or None
        (T, N) bool, cores that show something else than the object in a frame, and were left out there.
    quality : str or None
        "good"; "doubtful", where the image is worse than such a burst should give; "bad", where it does not show the
        object. The reasons are in `notes`. None where it has not been judged.
    misfit : float or None
        Root mean square of what the model leaves of the samples, in standard deviations of the camera's noise, which is
        measured in the burst: 1 for a perfect model (the root of the reduced chi-square).
    exposures : numpy.ndarray or None
        (T,) float64, brightness of each frame relative to the others, taken out of the image; their geometric mean is
        1. NaN for frames that do not take part.
    held_out_rmse : float or None
        Root mean square by which samples that were left out of the fit are missed, intensity units.
    frames_used : tuple of int or None
        Frames that take part. The others could not be registered; their homographies are NaN.
    confidence : numpy.ndarray or None
        (T,) 0 to 1, how well each frame agrees with the others where they overlap; NaN where the run ended before.
    reference : int
        The frame in whose pixels image and homographies are: 0, unless that frame could not be used.
    resolution : float or None
        Frame pixels, the finest period on which two halves of the burst agree (Fourier ring correlation of 1/7).
    agreement : RingCorrelation or None
        Of two halves of the burst, frequency by frequency, in frame pixels: what `resolution` was read from.
    notes : tuple of str
        What a user should know before trusting the image.
    """

    coverage: NDArray[np.float32] | None = None
    context: NDArray[np.int32] | None = None
    uncertainty: NDArray[np.float32] | None = None
    bundle: Bundle | None = None
    gain_ratios: NDArray[np.float32] | None = None
    gain_weights: NDArray[np.float32] | None = None
    residuals: NDArray[np.float32] | None = None
    outliers: NDArray[np.bool_] | None = None
    quality: Quality | None = None
    misfit: float | None = None
    exposures: NDArray[np.float64] | None = None
    held_out_rmse: float | None = None
    frames_used: tuple[int, ...] | None = None
    confidence: NDArray[np.float64] | None = None
    reference: int = 0
    resolution: float | None = None
    agreement: RingCorrelation | None = None
    notes: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Return what is not an image, as plain values that JSON can hold."""
        bundle = self.bundle
        return {
            "quality": self.quality,
            "misfit": _number(self.misfit),
            "outliers": None if self.outliers is None else int(self.outliers.sum()),
            "held_out_rmse": _number(self.held_out_rmse),
            "frames_used": self.frames_used,
            "confidence": _plain(self.confidence),
            "exposures": _plain(self.exposures),
            "reference": self.reference,
            "resolution": _number(self.resolution),
            "agreement": None
            if self.agreement is None
            else {name: _plain(getattr(self.agreement, name)) for name in ("frequency", "correlation")},
            "notes": self.notes,
            "bundle": None
            if bundle is None
            else {
                "pattern": bundle.pattern,
                "pitch": bundle.pitch,
                "cores": len(bundle.centres),
                "dead": len(bundle.dead),
                "saturated": int(bundle.saturated.sum()),
                "footprint_radius": bundle.radius,
                **bundle.provenance,
            },
        }

    def by_name(self) -> dict[str, Any]:
        """Return the diagnostics alone, by name."""
        return {item.name: getattr(self, item.name) for item in fields(Diagnostics)}


def _plain(values: NDArray[np.float64] | None) -> list[float | None] | None:
    """Return numbers as JSON can hold them, None for those that are not finite."""
    return None if values is None else [_number(value) for value in values]


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
