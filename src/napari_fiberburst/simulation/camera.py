"""A camera: noise, saturation, and whole numbers."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from napari_fiberburst.errors import SettingsError


@dataclass(frozen=True, kw_only=True)
class Camera:
    """What becomes of the light on its way to numbers.

    Attributes
    ----------
    photons : float
        Electrons at full scale: shot noise has a variance of signal / photons.
    read_noise : float
        Standard deviation in the dark, in parts of full scale.
    exposure : float
        Brightness; above 1 the brightest parts saturate.
    pedestal : float
        What the camera gives in the dark, in parts of full scale.
    bits : int
        8 gives uint8; 9 to 16 give uint16.
    """

    photons: float = 10_000.0
    read_noise: float = 0.0014
    exposure: float = 1.0
    pedestal: float = 0.0
    bits: int = 8

    def __post_init__(self) -> None:
        possible = (
            isinstance(self.bits, int)
            and 8 <= self.bits <= 16
            and self.photons > 0
            and 0 <= self.read_noise < 1
            and 0 < self.exposure < float("inf")
            and 0 <= self.pedestal < 1
        )
        if not possible:
            raise SettingsError(
                "a camera has 8 to 16 bits, photons and exposure above 0, and read_noise and pedestal in [0, 1); "
                f"got {self}"
            )

    @property
    def full_scale(self) -> int:
        """The largest number it gives."""
        return int(2**self.bits) - 1

    def record(self, light: NDArray[np.float32], rng: Generator) -> NDArray[Any]:
        """Turn light, 1 at full scale, into the camera's numbers; shot noise is Gaussian, as for many photons."""
        signal = light * np.float32(self.exposure)
        noise = rng.standard_normal(signal.shape, dtype=np.float32)
        noise *= np.sqrt(signal / np.float32(self.photons) + np.float32(self.read_noise**2))
        full = self.full_scale
        signal += noise
        signal *= np.float32(full * (1 - self.pedestal))
        signal += np.float32(full * self.pedestal)
        recorded: NDArray[Any] = np.clip(np.rint(signal, out=signal), 0, full, out=signal)
        return recorded.astype(np.uint8 if self.bits == 8 else np.uint16)
