"""Bright cells on a dark ground, as fluorescence shows them: the default, and with a bundle that is known.

    python -m benchmarks.dark_ground
    python -m benchmarks.dark_ground --bursts 24

Bursts differ in bundle, frames, light and motion, drawn at random. PSNR in dB against the truth of frame 0, where the
bundle reaches, beside the best Gaussian filter of that frame; `-` where the known bundle was refused.
"""

import argparse
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.ndimage import gaussian_filter

from benchmarks.methods import WIDTHS
from napari_fiberburst import reconstruct
from napari_fiberburst.errors import BundleError
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, SimulatedBurst, simulate


def main() -> int:
    """Parse the arguments, fit, print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.dark_ground",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--bursts", type=int, default=12, help="default 12")
    options = parser.parse_args()
    print("| burst | filtered | default | verdict | known bundle |\n| --- | --- | --- | --- | --- |")
    rows = []
    for seed in range(options.bursts):
        told, made = drawn(np.random.default_rng(seed), seed)
        rows.append(tried(made))
        print(rows[-1].line(told), flush=True)
    known = [row.known for row in rows if row.known is not None]
    means = [np.mean([row.filtered for row in rows]), np.mean([row.blind for row in rows])]
    print(f"| mean | {means[0]:.1f} | {means[1]:.1f} | | {np.mean(known):.1f} |")
    print(f"known bundles accepted: {len(known)} of {len(rows)}")
    return 0


@dataclass(frozen=True, kw_only=True)
class Tried:
    """PSNR, dB, of the best filter, of the default, and with the bundle (None if refused); the default's verdict."""

    filtered: float
    blind: float
    verdict: str | None
    known: float | None

    def line(self, told: str) -> str:
        """Return a row of the table, in Markdown."""
        known = "-" if self.known is None else f"{self.known:.1f}"
        return f"| {told} | {self.filtered:.1f} | {self.blind:.1f} | {self.verdict} | {known} |"


def drawn(rng: Generator, seed: int) -> tuple[str, SimulatedBurst]:
    """Draw a burst, and say what it is."""
    recipe: dict[str, Any] = {
        "shape": (int(rng.integers(120, 240)), int(rng.integers(120, 240))),
        "frames": int(rng.integers(5, 24)),
        "pitch": float(rng.uniform(3.5, 8)),
        "physics": str(rng.choice(["core", "mask"])),
        "motion": str(rng.choice(["brownian", "handheld"])),
    }
    photons = float(10 ** rng.uniform(2.8, 4.3))
    height, width = recipe["shape"]
    told = f"{recipe['frames']} x {height} x {width}, {recipe['physics']}, pitch {recipe['pitch']:.1f}, {photons:.0f} e"
    return told, simulate("cells", channels=1, camera=Camera(photons=photons), seed=seed, **recipe)


def tried(made: SimulatedBurst) -> Tried:
    """Reconstruct a burst without and with its bundle."""
    frame = made.burst.frames[0, ..., 0]
    blind, known = reconstruct(made.burst, fill=True, device="cpu"), None
    try:
        result = reconstruct(made.burst, fill=True, device="cpu", calibration=255 * made.transmission)
        known = _quality(result.image / 255, made)
    except BundleError:
        pass
    return Tried(
        filtered=max(_quality(gaussian_filter(frame, width), made) for width in WIDTHS),
        blind=_quality(blind.image / 255, made),
        verdict=blind.quality,
        known=known,
    )


def _quality(image: Any, made: SimulatedBurst) -> float:
    return psnr(np.nan_to_num(image)[..., None], made.truth[0])


if __name__ == "__main__":
    sys.exit(main())
