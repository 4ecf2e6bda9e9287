"""Parameters: dataclass fields that carry their own range and their own words.

A setting is described once, where it is declared. The reader of the code, ``--help`` and a form's tooltip all
show that text, and every settings object refuses values out of range by the same rule.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import Field, dataclass, field, fields
from functools import cache
from numbers import Integral, Real
from types import MappingProxyType, NoneType, UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from napari_fiberburst.errors import SettingsError

_IN_WORDS = {
    int: "an integer",
    float: "a number",
    str: "a text",
    bool: "true or false",
    tuple: "a tuple of frame numbers, the first one 0",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """One setting as a form or a command line needs it.

    Attributes
    ----------
    name : str
        The field's name.
    kind : type
        int, float, str, bool, or tuple, of frame numbers.
    default : object
        The value it has where nobody turns it.
    doc : str
        What it does and which way it turns.
    optional : bool
        Whether None is allowed (the text says what None does).
    least, above, most : float or None
        Inclusive lower, exclusive lower and inclusive upper bound.
    choices : tuple of str
        The allowed values, where they are a closed set.
    """

    name: str
    kind: type
    default: object
    doc: str
    optional: bool = False
    least: float | None = None
    above: float | None = None
    most: float | None = None
    choices: tuple[str, ...] = ()

    @property
    def expected(self) -> str:
        """The allowed values in words, as in "an integer of at least 1"."""
        if self.choices:
            words = "one of " + ", ".join(self.choices)
        else:
            words = _IN_WORDS[self.kind]
            bounds = [("of at least", self.least), ("above", self.above), ("of at most", self.most)]
            limits = " and ".join(f"{text} {bound:g}" for text, bound in bounds if bound is not None)
            words = f"{words} {limits}".strip()
        return f"{words}, or None" if self.optional else words

    def allows(self, value: object) -> bool:
        """Whether ``value`` has the right type and lies in range."""
        if value is None:
            return self.optional
        if self.kind is str:
            return isinstance(value, str) and (not self.choices or value in self.choices)
        if self.kind is bool:
            return isinstance(value, bool)
        if self.kind is tuple:
            return isinstance(value, tuple | list) and all(_is_frame_number(item) for item in value)
        wanted = Integral if self.kind is int else Real
        if isinstance(value, bool) or not isinstance(value, wanted):
            return False
        number = float(value)
        return (
            math.isfinite(number)
            and (self.least is None or number >= self.least)
            and (self.above is None or number > self.above)
            and (self.most is None or number <= self.most)
        )

    def check(self, value: object) -> None:
        """Refuse a value that is not allowed.

        Raises
        ------
        SettingsError
            Names the setting, what it may be and what came.
        """
        if not self.allows(value):
            raise SettingsError(f"{self.name} must be {self.expected}; got {value!r}")


def parameter(
    default: Any,
    doc: str,
    *,
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
) -> Any:
    """Declare a dataclass field with its text and range.

    Parameters
    ----------
    default : object
        Value where nobody turns it.
    doc : str
        One sentence: what it is, and what more of it does.
    least, above, most : float, optional
        Inclusive lower, exclusive lower and inclusive upper bound.

    Returns
    -------
    dataclasses.Field
        Typed as Any, so that it can stand as the default of a field of any type.
    """
    return field(default=default, metadata={"doc": doc, "least": least, "above": above, "most": most})


def parameters_of(settings_type: type) -> Mapping[str, Parameter]:
    """Return the parameters of a settings class by name, in the order they are declared."""
    return _parameters_of(settings_type)


@cache
def _parameters_of(settings_type: type) -> Mapping[str, Parameter]:
    """Read them once: every settings object that is made is checked against them."""
    hints = get_type_hints(settings_type)
    return MappingProxyType({item.name: _read(item, hints[item.name]) for item in _declared(settings_type)})


def check(settings: object) -> None:
    """Refuse a settings object with a value of the wrong type or out of range.

    Numbers of other kinds, such as numpy's, become Python's own, which every later use can take.

    Raises
    ------
    SettingsError
        Names the setting, what it may be and what came.
    """
    for name, parameter in parameters_of(type(settings)).items():
        value = getattr(settings, name)
        parameter.check(value)
        if value is not None:
            own = tuple(int(item) for item in value) if parameter.kind is tuple else parameter.kind(value)
            object.__setattr__(settings, name, own)  # of a frozen dataclass, while it is made


def _is_frame_number(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 0


def _declared(settings_type: type) -> Iterator[Field[Any]]:
    return (item for item in fields(settings_type) if "doc" in item.metadata)


def _read(item: Field[Any], hint: Any) -> Parameter:
    options = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    (kind,) = [option for option in options if option is not NoneType]
    kind = tuple if get_origin(kind) is tuple else kind
    choices = get_args(kind) if get_origin(kind) is Literal else ()
    return Parameter(
        name=item.name,
        kind=str if choices else kind,
        default=item.default,
        optional=NoneType in options,
        choices=choices,
        **item.metadata,
    )
