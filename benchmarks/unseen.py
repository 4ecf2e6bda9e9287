"""Bursts drawn at random: object, size, bundle, motion, light and faults, for verdicts that no limit was tuned on."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import skimage.data
from numpy.random import Generator

from napari_fiberburst.simulation import Camera, Faults, Scene, SimulatedBurst, simulate

# Behind every clean burst, so many with a fault; and how often with two.
FAULTY_EACH, _TWO_FAULTS = 3, 0.2
_SCENES = ("histology", "tissue", "cat", "usaf", "retina")
# How often the object is dark but for some cells.
_DARK = 0.1
_SHAPES = ((157, 171), (224, 224), (301, 253), (192, 240))
# How often frames are wide, or many: of objects that have so much to see without reflections.
_LARGE, _LARGE_SCENES = 0.15, ("tissue", "retina")
_LARGE_SHAPES, _MANY_FRAMES = ((801, 757), (411, 943)), (80, 150)
_FRAMES, _PITCHES, _PHOTONS = (6, 12, 20, 30), (3.5, 4.7, 6.0, 8.0), (600.0, 3000.0, 8000.0, 20_000.0)
# Of a photograph, the part that shows the object.
_PHOTOGRAPHS: Mapping[str, Callable[[], Any]] = {
    "histology": skimage.data.immunohistochemistry,
    "cat": skimage.data.cat,
    "retina": lambda: skimage.data.retina()[200:1200, 200:1200],
}


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """The recipe of a burst without faults.

    Attributes
    ----------
    scene : str
        One of the simulator's.
    place : (float, float)
        Where in a photograph frame 0 looks, (x, y) in parts of the room that there is.
    shape, frames, channels, motion, seed
        As in `napari_fiberburst.simulation.simulate`.
    pitch : float
        Pixels.
    photons : float
        Electrons at full scale.
    """

    scene: str
    place: tuple[float, float]
    shape: tuple[int, int]
    frames: int
    channels: int | None
    motion: str
    pitch: float
    photons: float
    seed: int

    def __str__(self) -> str:
        height, width = self.shape
        size = f"{self.frames} x {height} x {width}{'' if self.channels else ' RGB'}"
        return f"{self.scene}, {size}, pitch {self.pitch:g}, {self.photons:g} electrons, {self.motion}"

    def make(self, faults: Mapping[str, Any]) -> SimulatedBurst:
        """Simulate it with these faults."""
        return simulate(
            self._scene(),
            shape=self.shape,
            frames=self.frames,
            channels=self.channels,
            motion=self.motion,
            physics="core",
            camera=Camera(photons=self.photons),
            faults=Faults(**faults),
            seed=self.seed,
            pitch=self.pitch,
        )

    def _scene(self) -> str | Scene:
        if self.scene not in _PHOTOGRAPHS:
            return self.scene
        image = _PHOTOGRAPHS[self.scene]().astype(np.float32) / 255
        room = [max(have - want, 0) for have, want in zip(image.shape[1::-1], self.shape[::-1], strict=True)]
        return Scene(image, (round(self.place[0] * room[0]), round(self.place[1] * room[1])))


def unseen(seed: int) -> tuple[Drawn, Iterator[tuple[str, Mapping[str, Any]]]]:
    """Draw a burst, and names and settings of the faults to see it with."""
    rng, rng_large, rng_dark = (np.random.default_rng(part) for part in (seed, (seed, 1), (seed, 2)))
    drawn = Drawn(
        scene=str(rng.choice(_SCENES)),
        place=(rng.uniform(), rng.uniform()),
        shape=_SHAPES[rng.integers(len(_SHAPES))],
        frames=int(rng.choice(_FRAMES)),
        channels=1 if rng.uniform() < 0.7 else None,
        motion=str(rng.choice(["brownian", "handheld"])),
        pitch=float(rng.choice(_PITCHES)),
        photons=float(rng.choice(_PHOTONS)),
        seed=int(rng.integers(10_000)),
    )
    if rng_large.uniform() < _LARGE:
        drawn = replace(drawn, scene=str(rng_large.choice(_LARGE_SCENES)))
        if rng_large.uniform() < 0.5:
            drawn = replace(drawn, shape=_LARGE_SHAPES[rng_large.integers(len(_LARGE_SHAPES))], frames=12)
        else:
            drawn = replace(drawn, frames=int(rng_large.choice(_MANY_FRAMES)))
    if rng_dark.uniform() < _DARK:
        drawn = replace(drawn, scene="cells")
    return drawn, (_faults(rng, drawn.frames) for _ in range(FAULTY_EACH))


def _faults(rng: Generator, frames: int) -> tuple[str, Mapping[str, Any]]:
    """Draw one or two faults, from hardly there to beyond what the tables have."""

    def strength(least: float, most: float) -> float:
        return float(np.exp(rng.uniform(np.log(least), np.log(most))))

    most_unusable = 3 if frames > 6 else 2
    kinds: Mapping[str, Callable[[], dict[str, Any]]] = {
        "flicker": lambda: {"flicker": strength(0.01, 0.3)},
        "deformation": lambda: {"deformation": strength(0.5, 14), "deformation_length": strength(20, 120)},
        "smear": lambda: {"smear": float(rng.uniform(0.1, 1))},
        "background": lambda: {"background": strength(0.05, 2)},
        "vignette": lambda: {"vignette": strength(1.5, 10)},
        "field": lambda: {"field": float(rng.uniform(0.5, 0.97)), "overlay": bool(rng.uniform() < 0.7)},
        "intruder": lambda: {"intruder": strength(0.01, 0.2), "intruder_frames": float(rng.uniform(0.1, 0.6))},
        "unusable": lambda: {
            "black_frames": int(rng.integers(0, most_unusable)),
            "white_frames": int(rng.integers(1, most_unusable)),
        },
        "bundle shift": lambda: {"bundle_shift": strength(0.2, 3)},
        "contrast": lambda: {"contrast": strength(0.05, 0.25)},
    }
    chosen = rng.choice(list(kinds), 2 if rng.uniform() < _TWO_FAULTS else 1, replace=False)
    drawn: dict[str, Any] = {}
    for name in chosen:
        drawn |= kinds[str(name)]()
    told = ", ".join(f"{name} {value:.3g}" for name, value in drawn.items() if value)
    return told, drawn
