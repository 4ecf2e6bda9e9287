"""The bursts: what is to be seen, through what bundle, how it moves, and where each table uses it.

A case is a recipe. The same recipe gives the same burst, bit for bit, so that every method of a run, and every run,
sees the same one. Cases are named, and the names stand in the tables.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import skimage.data
from scipy.ndimage import zoom

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.simulation import Camera, Faults, Scene, SimulatedBurst, brownian_motion, simulate

# All faults together, each about as strong as in a recording made with care.
_MILD: Mapping[str, Any] = {
    "flicker": 0.03,
    "deformation": 1.0,
    "smear": 0.3,
    "background": 0.2,
    "vignette": 2.0,
    "field": 0.95,
    "overlay": True,
    "intruder": 0.02,
    "black_frames": 1,
    "white_frames": 1,
    "bundle_shift": 0.5,
}
# The published encoding's spread, cycles per half frame, and the cores across the bundle that it was chosen for.
PUBLISHED_SIGMA, PUBLISHED_CORES_ACROSS = 5.0, 188.0


@dataclass(frozen=True, kw_only=True)
class Case:
    """A simulated burst by its recipe.

    Attributes
    ----------
    name : str
        As the tables have it.
    scene : str
        One of the simulator's scenes, or "liver" or "kidney", two parts of its histology.
    side : int
        Frames are square, pixels: the peers can do no other.
    pitch : float
        Distance of the cores, pixels.
    physics : str
        "mask" or "core".
    frames, channels, seed
        As in `napari_fiberburst.simulation.simulate`.
    motion : str
        "brownian", "handheld", "raster", or "turning", which turns five times as much as "brownian".
    photons : float
        Electrons at full scale; fewer are noisier.
    bundle : mapping
        Further settings of the bundle.
    faults : mapping
        Settings of `napari_fiberburst.simulation.Faults`: what is wrong with the recording.
    magnify : float
        Photographs are enlarged so much before anything is seen of them.
    order : str
        "as recorded" or "shuffled": all frames but the first.
    keep : int, optional
        Of the frames, only so many; 1 stands for the first frame twice, since a burst has at least two.
    """

    name: str
    scene: str = "histology"
    side: int = 160
    pitch: float = 5.0
    physics: str = "core"
    frames: int = 20
    channels: int | None = None
    motion: str = "brownian"
    seed: int = 0
    photons: float = 10_000.0
    bundle: Mapping[str, Any] = field(default_factory=dict)
    faults: Mapping[str, Any] = field(default_factory=dict)
    magnify: float = 1.0
    order: str = "as recorded"
    keep: int | None = None

    @property
    def sigma(self) -> float:
        """Spread of the published encoding that is to this bundle as 5 is to the published one."""
        return PUBLISHED_SIGMA * self.side / self.pitch / PUBLISHED_CORES_ACROSS

    def __str__(self) -> str:
        size = f"{self.frames} x {self.side} x {self.side}"
        return f"{self.name}: {self.scene}, {self.physics}, {size}, pitch {self.pitch:g}"

    def make(self) -> SimulatedBurst:
        """Simulate the burst; the last one made is kept."""
        return _make(self)

    def __hash__(self) -> int:
        return hash(repr(self))

    def _whole(self) -> SimulatedBurst:
        shape = (self.side, self.side)
        turning = brownian_motion(self.frames, shape, np.random.default_rng(self.seed), rotation=2.0)
        return simulate(
            self._scene,
            shape=shape,
            frames=self.frames,
            channels=self.channels,
            motion=turning if self.motion == "turning" else self.motion,
            physics=self.physics,
            camera=Camera(photons=self.photons),
            faults=Faults(**self.faults),
            seed=self.seed,
            pitch=self.pitch,
            **self.bundle,
        )

    @cached_property
    def _scene(self) -> str | Scene:
        """Parts of photographs that the simulator has no name for."""
        corners = {"liver": (0.1, 0.1), "kidney": (0.45, 0.45)}
        if self.scene not in corners and self.magnify == 1:
            return self.scene
        loads = {"histology": skimage.data.immunohistochemistry, "cat": skimage.data.cat, "retina": skimage.data.retina}
        if self.scene not in corners and self.scene not in loads:
            return self.scene  # drawn at any size
        image = loads.get(self.scene, skimage.data.immunohistochemistry)().astype(np.float32) / 255
        large = np.clip(zoom(image, (self.magnify, self.magnify, 1), order=3, mode="mirror"), 0, 1)
        height, width = large.shape[:2]
        middle = ((width - self.side) / 2 / width, (height - self.side) / 2 / height)
        part_x, part_y = corners.get(self.scene, middle)
        return Scene(large, (round(part_x * width), round(part_y * height)))


@lru_cache(maxsize=1)
def _make(case: Case) -> SimulatedBurst:
    whole = case._whole()
    chosen = np.arange(case.frames)
    if case.order == "shuffled":
        chosen[1:] = np.random.default_rng(case.seed).permutation(chosen[1:])
    if case.keep is not None:
        chosen = np.array([0, 0]) if case.keep == 1 else chosen[: case.keep]
    return whole.take(chosen)


def comparison(*, is_quick: bool = False, is_large: bool = False) -> tuple[Case, ...]:
    """Return the five scenes of the paper's first table."""
    side, pitch, magnify = (96, 3.0, 1.0) if is_quick else (1000, 5.3, 4.5) if is_large else (224, 3.0, 1.0)
    seen = (("liver", "liver"), ("kidney", "kidney"), ("lens tissue", "tissue"), ("chart", "usaf"), ("cat", "cat"))
    cases = [
        Case(name=name, scene=scene, side=side, pitch=pitch, physics="mask", seed=seed, magnify=magnify)
        for seed, (name, scene) in enumerate(seen)
    ]
    return tuple(cases[2:4] if is_quick else cases)


def ablation(*, is_quick: bool = False) -> Case:
    """Return the burst of the second table."""
    return Case(name="ablation", scene="cat", side=96 if is_quick else 128, pitch=3.0, physics="mask", seed=7)


def conditions(*, is_quick: bool = False) -> tuple[Case, ...]:
    """Return the third table's bursts: one, and what becomes of it when one thing about it changes."""
    side = 96 if is_quick else 160
    base: dict[str, Any] = {"side": side}
    changed: list[tuple[str, dict[str, Any]]] = [
        ("as it is", {}),
        *[(f"{count} frame{'s' if count > 1 else ''}", {"keep": count}) for count in (1, 2, 5, 10)],
        ("frames shuffled", {"order": "shuffled"}),
        ("another Brownian walk", {"seed": 1}),
        ("by hand", {"motion": "handheld"}),
        ("raster", {"motion": "raster"}),
        ("turning", {"motion": "turning"}),
        *[(f"{count} electrons", {"photons": float(count)}) for count in (1000, 200)],
        *[(f"pitch {pitch}", {"pitch": float(pitch)}) for pitch in (3, 7, 10)],
        *[(f"jitter {jitter:g}", {"bundle": {"jitter": jitter}}) for jitter in (0.0, 0.2)],
        ("5 % dead cores", {"bundle": {"dead_cores": 0.05}}),
        ("mask bundle", {"physics": "mask"}),
        ("mask bundle, pitch 10", {"physics": "mask", "pitch": 10.0}),
        ("chart", {"scene": "usaf"}),
        ("retina", {"scene": "retina"}),
        ("tissue", {"scene": "tissue"}),
    ]
    cases = [Case(name=name, **{**base, **change}) for name, change in changed]
    return tuple(case for case in cases if case.name in ("as it is", "2 frames")) if is_quick else tuple(cases)


def recorded(*, is_quick: bool = False) -> tuple[Case, ...]:
    """Return the sixth table's bursts: each fault of recorded bursts at three strengths, and a mild one of each."""
    faults: list[tuple[str, Mapping[str, Any]]] = [
        *[(f"flicker {100 * part:g} %", {"flicker": part}) for part in (0.02, 0.05, 0.2)],
        *[(f"deformation {pixels:g} px", {"deformation": pixels}) for pixels in (1.0, 3.0, 6.0)],
        *[(f"smear {part:g} of a step", {"smear": part}) for part in (0.3, 0.6, 1.0)],
        *[(f"background {100 * part:g} %", {"background": part}) for part in (0.2, 0.5, 1.0)],
        *[(f"vignette {times:g} x", {"vignette": times}) for times in (2.0, 4.0, 8.0)],
        *[(f"round field {part:g}, marks", {"field": part, "overlay": True}) for part in (0.95, 0.8, 0.6)],
        *[(f"intruder {100 * part:g} %", {"intruder": part}) for part in (0.02, 0.05, 0.15)],
        *[(f"{n} black, {n} white", {"black_frames": n, "white_frames": n}) for n in (1, 2, 3)],
        *[(f"bundle shift {pixels:g} px", {"bundle_shift": pixels}) for pixels in (0.5, 1.0, 2.0)],
        *[(f"contrast {100 * part:g} %", {"contrast": part}) for part in (0.2, 0.1, 0.066)],
        ("all, mild", _MILD),
    ]
    if is_quick:
        faults = [(name, fault) for name, fault in faults if name in ("flicker 5 %", "deformation 3 px", "all, mild")]
    scenes = ("histology",) if is_quick else ("histology", "tissue")
    side = 96 if is_quick else 224
    return tuple(
        Case(name=f"{scene}, {name}", scene=scene, side=side, pitch=4.7, faults=fault)
        for scene in scenes
        for name, fault in faults
    )


def costs(*, is_quick: bool = False) -> tuple[Case, ...]:
    """Return the fifth table's bursts: frames, side and channels grow one by one, and the side in both physics."""
    if is_quick:
        sizes = [("core", 5, 96, 3), ("core", 10, 96, 3), ("mask", 5, 96, 3), ("mask", 10, 96, 3)]
    else:
        sides = [("core", 20, side, 3) for side in (256, 300, 424, 600)]
        frames = [("core", frames, 256, 3) for frames in (5, 10, 40)]
        channels = [("core", 20, 256, channels) for channels in (1, 8)]
        masks = [("mask", 20, side, 3) for side in (256, 300, 424, 600)]
        sizes = [*frames, *sides, *channels, *masks]
    return tuple(
        Case(
            name=f"{frames} x {side} x {side} x {channels}, {physics}",
            side=side,
            frames=frames,
            channels=channels,
            physics=physics,
        )
        for physics, frames, side, channels in sizes
    )


def largest_cost(*, is_quick: bool = False) -> Case:
    """Return the burst on which the fifth table times the stages of the default and the published method."""
    side = 96 if is_quick else 600
    return Case(name=f"20 x {side} x {side} x 3, core", side=side)


def find(names: list[str] | None, cases: tuple[Case, ...]) -> tuple[Case, ...]:
    """Return the cases of these names, all where there are no names.

    Raises
    ------
    SettingsError
        There is no such case.
    """
    known = {case.name: case for case in cases}
    for name in names or []:
        if name not in known:
            raise SettingsError(f"unknown case {name!r}; known: {', '.join(known)}")
    return cases if not names else tuple(known[name] for name in names)
