"""Named presets, and `choose`, which turns the keywords of a user into settings."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, replace
from typing import Any

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.settings.choices import ENCODINGS, MOTIONS, PUBLISHED_MOTIONS, AutoMotion, Deformable, Flow
from napari_fiberburst.settings.keywords import ENCODING_NAMES, keywords_of
from napari_fiberburst.settings.methods import METHODS, Method, NetworkMethod, PublishedMethod, SplineMethod
from napari_fiberburst.settings.parameter import Parameter, parameters_of
from napari_fiberburst.settings.settings import Settings, known_name, misplaced

PRESETS: Mapping[str, Settings] = {"auto": Settings(), "paper": Settings(method=PublishedMethod())}


def choose(preset: str | Settings = "auto", **choices: Any) -> Settings:
    """Return a preset with some of its values replaced.

    Parameters
    ----------
    preset : str or Settings
        Name of the preset to start from, or settings that take its place.
    **choices
        ``motion`` by name or as a settings object; ``encoding`` by name, "spline" among them, or as a settings object;
        ``observation``; any parameter of the method, motion or encoding chosen, or of `Settings`, by name. None leaves
        the preset's value. ``encoding="spline"`` chooses `SplineMethod`, ``observation="frames"`` `PublishedMethod`,
        and any other encoding `NetworkMethod`.

    Raises
    ------
    SettingsError
        A name is unknown, does not apply to the choice made, or a value is out of range. The known ones are listed.
    """
    settings = preset if isinstance(preset, Settings) else PRESETS[known_name("preset", preset, PRESETS)]
    known = all_keywords()
    given = {name: value for name, value in choices.items() if value is not None}
    for name in choices:
        if name not in ("motion", "encoding", *known):
            raise misplaced(name, settings)
        if name in known and name in given:
            known[name].check(given[name])
    observation, encoding = given.pop("observation", settings.flat()["observation"]), given.pop("encoding", None)
    kind = _kind_of(settings.method, observation, encoding)
    if kind is not SplineMethod and given.get("motion") == AutoMotion.name:
        del given["motion"]  # networks have one usual motion
    if kind is not SplineMethod and given.get("motion") == Deformable.name:
        raise SettingsError(
            f"motion {Deformable.name} needs encoding {SplineMethod.name!r}; with a network, take motion {Flow.name!r}"
        )
    values = _carried(settings.method, kind)
    values["motion"] = _turned(_part("motion", given.pop("motion", None), values["motion"], kind.motions), given)
    if "encoding" in values:
        part = _part("encoding", encoding, values["encoding"], ENCODINGS, ENCODING_NAMES)
        values["encoding"] = _turned(part, given)
    if "samples" in values:
        values["samples"] = observation
    elif given.pop("canvas", "frame") != "frame":
        raise SettingsError("observation frames draws the first frame's field alone; canvas must be frame")
    values |= {name: given.pop(name) for name in values if name in given}
    chosen: Settings = _turned(replace(settings, method=kind(**values)), given)
    if given:
        raise misplaced(next(iter(given)), chosen)
    return chosen


def all_keywords() -> dict[str, Parameter]:
    """Return every parameter there is by its keyword."""
    found: dict[str, Parameter] = {}
    for owner in (*METHODS.values(), Settings, *MOTIONS.values(), *PUBLISHED_MOTIONS.values(), *ENCODINGS.values()):
        for name, parameter in keywords_of(owner).items():
            # The first method leaves open what the published one has fixed: the keyword may be None.
            found.setdefault(name, parameter)
    return found


def choice_docs() -> Iterator[tuple[str, str, str]]:
    """Yield (part, name, one line of text) for every motion and encoding there is."""
    for part, known in (("motion", MOTIONS), ("encoding", {SplineMethod.name: SplineMethod, **ENCODINGS})):
        for name, choice in known.items():
            yield part, name, (choice.__doc__ or "").splitlines()[0]


def _kind_of(method: Method, observation: object, encoding: object) -> type[Method]:
    """Return the method that the keywords stand for; None leaves the encoding as it is."""
    if observation == "frames":
        if encoding == SplineMethod.name:
            raise SettingsError("the spline needs a bundle model; observation frames goes with a network encoding")
        return PublishedMethod
    is_spline = isinstance(method, SplineMethod) if encoding is None else encoding == SplineMethod.name
    return SplineMethod if is_spline else NetworkMethod


def _carried(method: Method, kind: type[Method]) -> dict[str, Any]:
    """Return the values of a method that another kind of method has too, and that kind's defaults for the rest."""
    usual = kind()
    values = {item.name: getattr(usual, item.name) for item in fields(kind)}
    values |= {name: kept for name in values if (kept := getattr(method, name, None)) is not None}
    if kind.motions is not method.motions:  # another family of motions: what is usual in it, or the namesake
        is_usual = type(method.motion) is type(type(method)().motion)
        values["motion"] = usual.motion if is_usual else kind.motions.get(method.motion.name, type(usual.motion))()
    return values


def _part(what: str, value: Any, preset: Any, known: Mapping[str, type], names: Iterable[str] | None = None) -> Any:
    """Return the settings object a name stands for: the preset's own where the name is the preset's, or there is none.

    An error lists `names`, by default all that are known.
    """
    if value is None or type(value) in known.values():
        return preset if value is None else value
    name = known_name(what, value, known if names is None else names)
    return preset if preset.name == name else known[name]()


def _turned(part: Any, given: dict[str, Any]) -> Any:
    """Return a settings object with the values given for its parameters, which are taken out of what is given."""
    return replace(part, **{name: given.pop(name) for name in parameters_of(type(part)) if name in given})
