"""What a picture rests on: what was measured, how well, and what was filled in."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cores:
    """The cores of a bundle, as a burst calibrated them.

    Attributes
    ----------
    centres : numpy.ndarray
        (N, 2) float64 as (x, y), frame pixels.
    gains : numpy.ndarray
        (N,) how much light each passes, as a part of a bright core's.
    radius : float
        Of the area over which a core gathers light, pixels.
    pitch : float
        Distance of neighbouring cores, pixels.
    saturated : numpy.ndarray
        (N,) bool, cores that were too bright for the camera in most frames.
    dead : numpy.ndarray
        (M, 2) float64, places in the lattice without light.
    """

    centres: NDArray[np.float64]
    gains: NDArray[np.float64]
    radius: float
    pitch: float
    saturated: NDArray[np.bool_]
    dead: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """What is known of a reconstruction beside its picture; None where the method does not tell.

    Attributes
    ----------
    coverage : numpy.ndarray or None
        (H, W) float32 on the canvas: how many core samples have seen each pixel; 0 where the picture is filled in
        from its surroundings.
    uncertainty : numpy.ndarray or None
        (H, W) float32 on the canvas, the standard deviation to be expected of the picture, intensity units, averaged
        over the channels. It holds what noise and gaps do, not what a wrong model does.
    transmission : numpy.ndarray or None
        (H, W) or (H, W, C) float32, the part of the light that each frame pixel passes, 1 for a bright core.
    cores : Cores or None
        The bundle's cores; None where none can be told apart.
    residuals : numpy.ndarray or None
        (T, N) float32, root mean square by which the model misses each core in each frame, intensity units; NaN
        where there is no sample.
    sample_error : float or None
        Root mean square by which samples that were left out of the fit are missed, intensity units.
    frames_used : tuple of int or None
        Frames that take part. The others could not be registered; their homographies are NaN.
    confidence : numpy.ndarray or None
        (T,) 0 to 1, how well each frame agrees with the others where they overlap; NaN where the run ended before.
    reference : int
        The frame in whose pixels picture and homographies are: 0, unless that frame could not be used.
    resolution : float or None
        Frame pixels, the finest period on which two halves of the burst agree (Fourier ring correlation of 1/7).
    notes : tuple of str
        What a user should know before trusting the picture.
    """

    coverage: NDArray[np.float32] | None = None
    uncertainty: NDArray[np.float32] | None = None
    transmission: NDArray[np.float32] | None = None
    cores: Cores | None = None
    residuals: NDArray[np.float32] | None = None
    sample_error: float | None = None
    frames_used: tuple[int, ...] | None = None
    confidence: NDArray[np.float64] | None = None
    reference: int = 0
    resolution: float | None = None
    notes: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Return what is not a picture, as plain values that JSON can hold."""
        cores = self.cores
        return {
            "sample_error": self.sample_error,
            "frames_used": self.frames_used,
            "confidence": None
            if self.confidence is None
            else [float(value) if np.isfinite(value) else None for value in self.confidence],
            "reference": self.reference,
            "resolution": self.resolution,
            "notes": self.notes,
            "bundle": None
            if cores is None
            else {
                "pitch": cores.pitch,
                "cores": len(cores.centres),
                "dead": len(cores.dead),
                "saturated": int(cores.saturated.sum()),
                "footprint_radius": cores.radius,
            },
        }

    def evidence(self) -> dict[str, Any]:
        """Return the evidence alone, by name."""
        return {item.name: getattr(self, item.name) for item in fields(Evidence)}
