"""Frozen settings and named presets. Standard library only, so that reading them costs nothing.

`choose` turns what a user says (a preset's name, a motion, an encoding, any field by name) into one `Settings`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, ClassVar, get_args

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.knobs import check, knob, knobs_of


@dataclass(frozen=True, slots=True, kw_only=True)
class NoEncoding:
    """The coordinates as they are: a smooth picture without fine detail."""

    name: ClassVar[str] = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class NeRF:
    """Sines and cosines at octaves (Mildenhall et al., 2020)."""

    name: ClassVar[str] = "nerf"
    highest_octave: int = knob(
        15, "L of the octaves 2^0 to 2^L; more resolve finer detail, noise and honeycomb.", least=0, most=24
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fourier:
    """Random Fourier features (Tancik et al., 2020)."""

    name: ClassVar[str] = "fourier"
    features: int = knob(256, "Random frequencies; more resolve detail more evenly, at more cost.", least=1, most=2**16)
    sigma: float = knob(
        5.0,
        "Frequency spread, cycles per half frame; more resolves finer detail, and in the end the honeycomb.",
        above=0,
        most=1e6,
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hash:
    """Multi-resolution hash grid (Müller et al., 2022)."""

    name: ClassVar[str] = "hash"
    levels: int = knob(12, "Grid levels; more resolve finer detail.", least=1, most=24)
    level_features: int = knob(2, "Learned values per grid point; more can hold more, at more cost.", least=1, most=64)
    table_bits: int = knob(16, "Binary log of the table length; more means fewer collisions.", least=4, most=24)
    base_resolution: int = knob(4, "Cells across the frame at the coarsest level.", least=1, most=4096)
    growth: float = knob(1.61, "Ratio of cells from one level to the next; more reaches finer cells.", above=1, most=2)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Siren:
    """Sine activations instead of an encoding (Sitzmann et al., 2020)."""

    name: ClassVar[str] = "siren"
    omega_0: float = knob(30.0, "Frequency of the sine activations; more resolves finer detail.", above=0, most=1e4)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoMotion:
    """No motion: the scene network memorises space and time, f(x, y, t)."""

    name: ClassVar[str] = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class _MotionNetwork:
    motion_layers: int = knob(3, "Hidden layers of the motion network.", least=1, most=64)
    motion_width: int = knob(256, "Units per hidden layer of the motion network.", least=1, most=2**14)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Homography(_MotionNetwork):
    """One 3x3 homography per frame: a flat object, seen from anywhere."""

    name: ClassVar[str] = "homography"


@dataclass(frozen=True, slots=True, kw_only=True)
class Flow(_MotionNetwork):
    """A displacement per pixel and frame, from a sine network: objects that deform."""

    name: ClassVar[str] = "flow"
    flow_omega_0: float = knob(
        30.0, "Frequency of the motion network's sine activations; more bends the flow more.", above=0, most=1e4
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowTV(Flow):
    """Optical flow with total variation: displacements that change little from pixel to pixel."""

    name: ClassVar[str] = "flow_tv"
    tv_weight: float = knob(1.0, "Weight of the flow's total variation; more makes it smoother.", least=0)


Encoding = NoEncoding | NeRF | Fourier | Hash | Siren
Motion = NoMotion | Homography | Flow | FlowTV

ENCODINGS: Mapping[str, type[Encoding]] = {choice.name: choice for choice in get_args(Encoding)}
MOTIONS: Mapping[str, type[Motion]] = {choice.name: choice for choice in get_args(Motion)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """All that a reconstruction depends on beside the burst itself.

    Attributes
    ----------
    motion : NoMotion, Homography, Flow or FlowTV
        How the object moves between frames.
    encoding : NoEncoding, NeRF, Fourier, Hash or Siren
        How coordinates are presented to the scene network.

    Notes
    -----
    The other attributes are knobs; `napari_fiberburst.knobs.knobs_of` lists them with their text and range.
    The defaults are the published ones ("Seeing through fibers", 2026).
    """

    motion: Motion = field(default_factory=Homography)
    encoding: Encoding = field(default_factory=Fourier)
    scene_layers: int = knob(4, "Hidden layers of the scene network.", least=1, most=64)
    scene_width: int = knob(
        256, "Units per hidden layer of the scene network; more holds more detail.", least=1, most=2**14
    )
    iterations: int = knob(3000, "Optimisation steps; more fits closer, in the end noise too.", least=1)
    learning_rate: float = knob(1e-4, "Step size of Adam; more is faster and less stable.", above=0, most=1e6)
    batch: int | None = knob(None, "Samples per step; None takes an eighth of a frame's pixels, as published.", least=1)
    seed: int = knob(0, "Seed of everything random; the same seed gives the same picture.", least=0, most=2**31 - 1)
    device: str = knob("auto", "Where to compute: auto, cpu, cuda, cuda:1, mps; auto takes the fastest there is.")
    time_budget: float | None = knob(
        None, "Seconds after which to stop with what there is; None for no limit.", above=0
    )
    preview_every: float | None = knob(
        None, "Seconds between preview pictures while fitting; None makes none.", above=0
    )

    def __post_init__(self) -> None:
        for part, known in ((self.motion, MOTIONS), (self.encoding, ENCODINGS)):
            if type(part) not in known.values():
                names = ", ".join(choice.__name__ for choice in known.values())
                raise SettingsError(f"expected a settings object, one of {names}; got {part!r}")
        check(self)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values that JSON can hold; `from_dict` reads them back."""
        plain = asdict(self)
        for part in ("motion", "encoding"):
            plain[part] = {"name": getattr(self, part).name, **plain[part]}
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "Settings":
        """Rebuild settings from `to_dict`'s values.

        Raises
        ------
        SettingsError
            A name or a value is not one this version knows.
        """
        flat = dict(plain)
        for part in ("motion", "encoding"):
            chosen = dict(flat.pop(part, {}))
            flat[part] = chosen.pop("name", None)
            flat.update(chosen)
        return choose(**flat)


_ALL_NAMES = {item.name for owner in (Settings, *MOTIONS.values(), *ENCODINGS.values()) for item in fields(owner)}

PRESETS: Mapping[str, Settings] = {"paper": Settings()}


def choose(preset: str | Settings = "paper", **choices: Any) -> Settings:
    """Return a preset with some of its values replaced.

    Parameters
    ----------
    preset : str or Settings
        Name of the preset to start from, or settings that take its place.
    **choices
        ``motion`` and ``encoding`` by name or as settings objects; any field of `Settings`, or of the motion or
        the encoding chosen, by name. None leaves the preset's value.

    Raises
    ------
    SettingsError
        A name is unknown, does not apply to the choice made, or a value is out of range. The known ones are listed.
    """
    settings = preset if isinstance(preset, Settings) else PRESETS[_known("preset", preset, PRESETS)]
    for name in choices:
        if name not in _ALL_NAMES:
            raise SettingsError(_misplaced(name, settings, settings.motion, settings.encoding))
    given = {name: value for name, value in choices.items() if value is not None}
    motion = _part("motion", given.pop("motion", settings.motion), settings.motion, MOTIONS)
    encoding = _part("encoding", given.pop("encoding", settings.encoding), settings.encoding, ENCODINGS)
    own, of_motion, of_encoding = (
        {name: given.pop(name) for name in knobs_of(type(part)) if name in given}
        for part in (settings, motion, encoding)
    )
    if given:
        raise SettingsError(_misplaced(next(iter(given)), settings, motion, encoding))
    return replace(settings, motion=replace(motion, **of_motion), encoding=replace(encoding, **of_encoding), **own)


def choice_docs() -> Iterator[tuple[str, str, str]]:
    """Yield (part, name, one line of text) for every motion and encoding there is."""
    for part, known in (("motion", MOTIONS), ("encoding", ENCODINGS)):
        for name, choice in known.items():
            yield part, name, (choice.__doc__ or "").splitlines()[0]


def _known(what: str, name: object, known: Mapping[str, object]) -> str:
    if not isinstance(name, str) or name not in known:
        raise SettingsError(f"unknown {what} {name!r}; known: {', '.join(known)}")
    return name


def _part(what: str, value: Any, preset: Any, known: Mapping[str, type]) -> Any:
    """Return the settings object a name stands for: the preset's own where the name is the preset's."""
    if type(value) in known.values():
        return value
    name = _known(what, value, known)
    return preset if preset.name == name else known[name]()


def _misplaced(name: str, settings: Settings, motion: Motion, encoding: Encoding) -> str:
    usable = [*(item.name for item in fields(Settings)), *knobs_of(type(motion)), *knobs_of(type(encoding))]
    owners = [
        f"{part} {choice.name!r}"
        for part, known in (("motion", MOTIONS), ("encoding", ENCODINGS))
        for choice in known.values()
        if name in knobs_of(choice)
    ]
    chosen = f"motion {motion.name!r} with encoding {encoding.name!r}"
    problem = f"belongs to {' and '.join(owners)} and does not apply to {chosen}" if owners else "is no setting"
    return f"{name} {problem}; known with {chosen}: {', '.join(usable)}"
