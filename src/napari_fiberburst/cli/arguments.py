"""Command line options made from the settings' own docs."""

import argparse
from typing import Any, NoReturn

from napari_fiberburst.settings import ENCODING_NAMES, MOTIONS, PRESETS, all_keywords, choice_docs, owners_of
from napari_fiberburst.settings.parameter import Parameter


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add an option for the preset, the motion, the encoding, and every parameter there is."""
    parser.add_argument("--preset", choices=PRESETS, default=next(iter(PRESETS)), help="where settings start from")
    for part, known in (("motion", tuple(MOTIONS)), ("encoding", ENCODING_NAMES)):
        texts = [f"{name}: {text}" for of, name, text in choice_docs() if of == part]
        parser.add_argument(f"--{part}", choices=known, help=" ".join(texts).replace("%", "%%"))
    for name, parameter in all_keywords().items():
        add_parameter(parser, parameter, " and ".join(choice for _, choice in owners_of(name)))


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """Return what `napari_fiberburst.settings.choose` takes, from parsed options; unset ones are None."""
    return {name: getattr(options, name) for name in sorted({"preset", "motion", "encoding", *all_keywords()})}


def add_frames(parser: argparse.ArgumentParser) -> None:
    """Add the option that chooses frames of a recording."""
    parser.add_argument(
        "--frames", metavar="FIRST:STOP[:STEP]", help="use these frames alone, such as 100:120 or 100:200:5"
    )


def parse_crop(text: str) -> tuple[tuple[int, int], tuple[int, int]]:
    """Read ``y0:y1,x0:x1`` as rows and columns."""
    try:
        rows, columns = (tuple(int(edge) for edge in part.split(":")) for part in text.split(","))
        (y0, y1), (x0, x1) = rows, columns
    except ValueError:
        _refuse(f"expected y0:y1,x0:x1, such as 400:700,430:730; got {text!r}")
    return (y0, y1), (x0, x1)


def parse_shape(text: str) -> tuple[int, int]:
    """Read ``HEIGHTxWIDTH``."""
    try:
        height, width = (int(side) for side in text.lower().split("x"))
    except ValueError:
        _refuse(f"expected HEIGHTxWIDTH, such as 256x256; got {text!r}")
    return height, width


def add_parameter(parser: Any, parameter: Parameter, owner: str = "") -> None:
    """Add an option for a parameter to a parser or a group of one; unset, it is None.

    `owner` names the choices that the parameter belongs to.
    """
    value = f"{parameter.default:g}" if isinstance(parameter.default, float) else parameter.default
    default = "" if value in (None, ()) else f"default {value}"
    remarks = "; ".join(filter(None, [owner and f"{owner} only", default]))
    text = f"{parameter.doc} ({remarks})" if remarks else parameter.doc
    if parameter.kind is bool:
        parser.add_argument(f"--{parameter.name.replace('_', '-')}", action=argparse.BooleanOptionalAction, help=text)
        return
    if parameter.choices:
        parser.add_argument(f"--{parameter.name.replace('_', '-')}", choices=parameter.choices, help=text)
        return
    if parameter.kind is tuple:
        parser.add_argument(f"--{parameter.name.replace('_', '-')}", nargs="+", type=int, metavar="FRAME", help=text)
        return
    parser.add_argument(
        f"--{parameter.name.replace('_', '-')}", type=parameter.kind, metavar=parameter.kind.__name__.upper(), help=text
    )


def _refuse(message: str) -> NoReturn:
    raise argparse.ArgumentTypeError(message)
