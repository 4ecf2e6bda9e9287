"""Frozen settings, as values and as JSON. Standard library only, so that reading them costs little."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, TypeVar

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.settings.choices import ENCODINGS, Motion
from napari_fiberburst.settings.keywords import keywords_of, owners_of
from napari_fiberburst.settings.methods import METHODS, Method, NetworkMethod, PublishedMethod, SplineMethod
from napari_fiberburst.settings.parameter import Parameter, check, parameter, parameters_of

Chosen = TypeVar("Chosen")
# None is a choice there, not an open question: no limit, and no previews.
_MAY_BE_NONE = ("time_budget", "preview_every", "memory")
# Bytes of each unit.
_UNITS = {"MB": 10**6, "GB": 10**9, "TB": 10**12, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """All that a reconstruction depends on beside the burst itself.

    Attributes
    ----------
    method : SplineMethod, NetworkMethod or PublishedMethod
        How the burst is reconstructed, with the settings that apply to that method alone.

    Notes
    -----
    The other attributes are parameters; `napari_fiberburst.settings.parameter.parameters_of` lists them.
    The defaults are the preset "auto"; what is None or "auto" there is chosen from the burst.
    """

    method: Method = field(default_factory=SplineMethod)
    seed: int = parameter(0, "Seed of everything random; the same seed gives the same image.", least=0, most=2**31 - 1)
    device: str = parameter("auto", "Where to compute: auto, cpu, cuda, cuda:1, mps; auto takes cuda where it is.")
    time_budget: float | None = parameter(
        None, "Seconds after which to stop with what there is; None for no limit.", above=0
    )
    preview_every: float | None = parameter(
        None,
        "Seconds between preview images while fitting, or more where drawing would slow the fit; None makes none.",
        above=0,
    )

    memory: str | None = parameter(
        None,
        'Memory that a run may take beside the burst, such as "4 GB"; a network then sees its batches in parts, and '
        "what cannot fit is refused. None sets no limit.",
    )

    def __post_init__(self) -> None:
        if type(self.method) not in METHODS.values():
            names = ", ".join(method.__name__ for method in METHODS.values())
            raise SettingsError(f"method must be one of {names}; got {self.method!r}")
        check(self)
        if self.memory is not None:
            bytes_of(self.memory)

    @property
    def motions(self) -> Mapping[str, type[Motion]]:
        """The motions that the keyword `motion` takes with the observation as it is, by name."""
        return self.method.motions

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The parameters that turn something with the method chosen, by their keywords."""
        return {name: parameter for part in self._parts() for name, parameter in keywords_of(type(part)).items()}

    @property
    def left_open(self) -> tuple[str, ...]:
        """The keywords of what is still to be chosen from the burst or the machine; a result's settings have none."""
        return tuple(
            name for name, value in self.flat().items() if value in (None, "auto") and name not in _MAY_BE_NONE
        )

    def flat(self) -> dict[str, Any]:
        """Return the settings as the keywords that `choose` and `napari_fiberburst.reconstruct` take."""
        turned = {name: getattr(part, name) for part in self._parts() for name in parameters_of(type(part))}
        observation = turned.pop("samples", "frames")
        encoding = self.method.name if isinstance(self.method, SplineMethod) else self.method.encoding.name
        return {"motion": self.method.motion.name, "encoding": encoding, "observation": observation, **turned}

    def value_of(self, name: str) -> Any:
        """Return what a parameter is turned to, be it of the motion, the encoding, the method or the rest.

        Raises
        ------
        SettingsError
            There is no such parameter with the method chosen.
        """
        if name not in self.parameters:
            raise misplaced(name, self)
        return self.flat()[name]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values that JSON can hold; `from_dict` reads them back."""
        plain: dict[str, Any] = _plain(self)
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "Settings":
        """Rebuild settings from `to_dict`'s values, or from those of version 0.1.0.

        Raises
        ------
        SettingsError
            A name or a value is not one this version knows.
        """
        values = _mapping("settings", plain)
        if "method" not in values:
            values = _nested(values)
        kind, method = _chosen("method", values["method"], METHODS)
        for part, known in (("motion", kind.motions), ("encoding", ENCODINGS)):
            if part in method:
                method[part] = _built(*_chosen(part, method[part], known))
        return _built(cls, {**values, "method": _built(kind, method)})

    def _parts(self) -> tuple[object, ...]:
        """Return the dataclasses that hold the parameters."""
        parts = (getattr(self.method, part, None) for part in ("motion", "encoding"))
        return (*(part for part in parts if part is not None), self.method, self)


def bytes_of(memory: str) -> int:
    """Return how many bytes a text such as "4 GB" stands for.

    Raises
    ------
    SettingsError
        It is no positive number with a unit.

    Examples
    --------
    >>> bytes_of("4 GB"), bytes_of("1.5GiB")
    (4000000000, 1610612736)
    """
    told = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]+)\s*", memory)
    size = 0 if told is None else int(float(told[1]) * _UNITS.get(told[2], 0))
    if size <= 0:
        raise SettingsError(f"memory must be a positive number with a unit, {', '.join(_UNITS)}; got {memory!r}")
    return size


def misplaced(name: str, settings: Settings) -> SettingsError:
    """Return the error for a keyword that is unknown, or does not apply to the choice made."""
    flat = settings.flat()
    owners = [f"{part} {choice!r}" if part else choice for part, choice in owners_of(name)]
    chosen = f"motion {flat['motion']!r} with encoding {flat['encoding']!r}"
    published = "the published method, " if isinstance(settings.method, PublishedMethod) else ""
    problem = "is no setting"
    if owners:
        problem = f"belongs to {' and '.join(owners)} and does not apply to {published}{chosen}"
    return SettingsError(f"{name} {problem}; known with {chosen}: {', '.join(flat)}")


def known_name(what: str, name: object, known: Iterable[str]) -> str:
    """Return a name that is among the known ones.

    Raises
    ------
    SettingsError
        It is not; the message lists them.
    """
    known = tuple(known)
    if not isinstance(name, str) or name not in known:
        raise SettingsError(f"unknown {what} {name!r}; known: {', '.join(known)}")
    return name


def _plain(value: Any) -> Any:
    """Return a dataclass as a dictionary, with the name of the choice that it stands for."""
    if not is_dataclass(value):
        return value
    named = {"name": value.name} if hasattr(value, "name") else {}
    return {**named, **{item.name: _plain(getattr(value, item.name)) for item in fields(value)}}


def _mapping(what: str, value: object) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise SettingsError(f"{what} must be a mapping of names to values; got {value!r}")
    return dict(value)


def _chosen(what: str, plain: object, known: Mapping[str, type[Chosen]]) -> tuple[type[Chosen], dict[str, Any]]:
    """Return the class that the plain values of a choice name, and the other values."""
    values = _mapping(what, plain)
    return known[known_name(what, values.pop("name", None), known)], values


def _built(kind: type[Chosen], values: Mapping[str, Any]) -> Chosen:
    names = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    for name in values:
        if name not in names:
            raise SettingsError(f"{name} is no setting of {kind.__name__}; known: {', '.join(names)}")
    return kind(**values)


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return what version 0.1.0 wrote as it is written now.

    There, all parameters stood on one level, those of other methods too, and motion and encoding, the spline among the
    encodings, beside them.
    """
    motion, encoding = (_mapping(part, flat.get(part)) for part in ("motion", "encoding"))
    kind: type[Method] = NetworkMethod
    if flat.get("observation") == "frames":
        kind = PublishedMethod
    elif encoding.get("name") == SplineMethod.name:
        kind = SplineMethod
    given = {**flat, "samples": flat.get("observation"), "motion": motion, "encoding": encoding}
    given |= {"smoothness": encoding.get("smoothness")}
    own, settings = ({item.name for item in fields(owner)} for owner in (kind, Settings))
    method = {name: value for name, value in given.items() if name in own and value is not None}
    rest = {name: value for name, value in given.items() if name in settings}
    return {**rest, "method": {"name": kind.name, **method}}
