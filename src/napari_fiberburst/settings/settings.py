"""Frozen settings and named presets. Standard library only, so that reading them costs nothing.

`choose` turns what a user says (a preset's name, a motion, an encoding, any field by name) into one `Settings`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.settings.choices import (
    ENCODINGS,
    MOTIONS,
    PUBLISHED_MOTIONS,
    Encoding,
    Flow,
    Fourier,
    Homography,
    HomographyNetwork,
    Motion,
    Spline,
)
from napari_fiberburst.settings.parameter import Knob, check, knob, knobs_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """All that a reconstruction depends on beside the burst itself.

    Attributes
    ----------
    motion : Motion
        How the object moves between frames.
    encoding : Encoding
        How the scene is held: as a spline, or as a network of coordinates that are presented in one of these ways.

    Notes
    -----
    The other attributes are knobs; `napari_fiberburst.settings.parameter.knobs_of` lists them with their text and
    range.
    The defaults are the preset "auto"; what is None there is chosen from the burst.
    """

    motion: Motion = field(default_factory=Homography)
    encoding: Encoding = field(default_factory=Spline)
    observation: Literal["auto", "cores", "pixels", "frames"] = knob(
        "auto",
        "What is taken as one sensor behind the self-calibrated bundle: each core, each lit pixel, or, auto, what the "
        "burst itself shows; frames stands for the published method, which has no bundle model.",
    )
    canvas: Literal["frame", "union"] = knob(
        "frame", "What the picture covers: the first frame's field, or all that any frame saw."
    )
    upsample: float = knob(1.0, "Picture pixels to a frame pixel, along each axis.", above=0, most=16)
    fill: bool = knob(False, "Fill in the picture where no core has looked, instead of leaving it empty (NaN).")
    held_out: float = knob(
        0.05, "Part of the samples that is left out of the fit and tells how well it predicts.", least=0, most=0.5
    )
    scene_layers: int = knob(4, "Hidden layers of the scene network.", least=1, most=64)
    scene_width: int = knob(
        256, "Units per hidden layer of the scene network; more holds more detail.", least=1, most=2**14
    )
    iterations: int | None = knob(
        None, "Optimisation steps at most; more fits closer, in the end noise too. None lets the burst choose.", least=1
    )
    learning_rate: float | None = knob(
        None,
        "Step size of Adam; more is faster and less stable. None suits the encoding; as published, 1e-4.",
        above=0,
        most=1e6,
    )
    batch: int | None = knob(None, "Samples per step; None takes an eighth of a frame's pixels, as published.", least=1)
    seed: int = knob(0, "Seed of everything random; the same seed gives the same picture.", least=0, most=2**31 - 1)
    device: str = knob("auto", "Where to compute: auto, cpu, cuda, cuda:1, mps; auto takes the fastest there is.")
    time_budget: float | None = knob(
        None, "Seconds after which to stop with what there is; None for no limit.", above=0
    )
    preview_every: float | None = knob(
        None,
        "Seconds between preview pictures while fitting, or more where drawing would slow the fit; None makes none.",
        above=0,
    )

    def __post_init__(self) -> None:
        for part, known in (("motion", self.motions), ("encoding", ENCODINGS)):
            if type(getattr(self, part)) not in known.values():
                names = ", ".join(choice.__name__ for choice in known.values())
                raise SettingsError(
                    f"with observation {self.observation!r}, {part} must be one of {names}; got {getattr(self, part)!r}"
                )
        check(self)
        if self.is_published and isinstance(self.encoding, Spline):
            raise SettingsError("the spline needs a bundle model; observation frames goes with a network encoding")
        if self.is_published and self.canvas != "frame":
            raise SettingsError("observation frames draws the first frame's field alone; canvas must be frame")
        if isinstance(self.encoding, Spline) and isinstance(self.motion, Flow):
            raise SettingsError(
                f"motion {self.motion.name} needs a network encoding: {', '.join(list(ENCODINGS)[1:])}; not the spline"
            )

    @property
    def is_published(self) -> bool:
        """Whether this is the published method, without a bundle model."""
        return self.observation == "frames"

    @property
    def motions(self) -> Mapping[str, type[Motion]]:
        """The motions that go with the observation, by name."""
        return PUBLISHED_MOTIONS if self.is_published else MOTIONS

    @property
    def knobs(self) -> dict[str, Knob]:
        """The knobs that turn something with this motion, encoding and observation, by name."""
        own = knobs_of(Settings)
        if isinstance(self.encoding, Spline):
            idle = {"scene_layers", "scene_width", "learning_rate", "batch"}
        elif self.is_published:
            idle = {"canvas", "fill", "held_out"}
        else:
            idle = set()
        used = {name: knob for name, knob in own.items() if name not in idle}
        return {**knobs_of(type(self.motion)), **knobs_of(type(self.encoding)), **used}

    def value_of(self, name: str) -> Any:
        """Return what a knob is turned to, be it of the motion, the encoding or the rest.

        Raises
        ------
        SettingsError
            There is no such knob with the motion and encoding chosen.
        """
        for part in (self.encoding, self.motion, self):
            if name in knobs_of(type(part)):
                return getattr(part, name)
        raise SettingsError(_misplaced(name, self, self.motion, self.encoding))

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


_ALL_NAMES = {
    item.name
    for owner in (Settings, *MOTIONS.values(), *PUBLISHED_MOTIONS.values(), *ENCODINGS.values())
    for item in fields(owner)
}

PRESETS: Mapping[str, Settings] = {
    "auto": Settings(),
    "paper": Settings(
        motion=HomographyNetwork(),
        encoding=Fourier(sigma=5.0),
        observation="frames",
        iterations=3000,
        learning_rate=1e-4,
    ),
}


def choose(preset: str | Settings = "auto", **choices: Any) -> Settings:
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
    settings = _observed(settings, given.pop("observation", settings.observation))
    motion = _part("motion", given.pop("motion", settings.motion), settings.motion, settings.motions)
    encoding = _part("encoding", given.pop("encoding", settings.encoding), settings.encoding, ENCODINGS)
    own, of_motion, of_encoding = (
        {name: given.pop(name) for name in knobs_of(type(part)) if name in given}
        for part in (settings, motion, encoding)
    )
    if given:
        raise SettingsError(_misplaced(next(iter(given)), settings, motion, encoding))
    return replace(settings, motion=replace(motion, **of_motion), encoding=replace(encoding, **of_encoding), **own)


def _observed(settings: Settings, observation: Any) -> Settings:
    """Return the settings with another observation; where it has the other family of motions, with its namesake."""
    known = knobs_of(Settings)["observation"]
    if not known.allows(observation):
        raise SettingsError(f"observation must be {known.expected}; got {observation!r}")
    if (observation == "frames") == settings.is_published:
        return replace(settings, observation=observation)
    changed = PRESETS["paper" if observation == "frames" else "auto"]
    motion = changed.motions.get(settings.motion.name, type(changed.motion))()
    encoding = changed.encoding if isinstance(settings.encoding, Spline) else settings.encoding
    return replace(settings, observation=observation, motion=motion, encoding=encoding)


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
