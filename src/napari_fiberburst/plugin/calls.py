"""A run as a call that anyone can repeat: in Python, or on the command line."""

import shlex
from collections.abc import Mapping
from typing import Any

from napari_fiberburst.plugin.bundles import BundleSource
from napari_fiberburst.plugin.bursts import BurstSource


def as_python(
    source: BurstSource, choices: Mapping[str, Any], bundle: BundleSource | None = None, *, before: str = ""
) -> str:
    """Return the lines of Python that do what the form is set to do.

    Parameters
    ----------
    source : BurstSource
        The burst; one that was not opened from a file is taken from the viewer, as napari's console knows it.
    choices : mapping
        What `napari_fiberburst.reconstruct` takes by name.
    bundle : BundleSource, optional
        The bundle; one that was not opened from a file is an image, and taken from the viewer.
    before : str
        The lines that made the result which this run continues.
    """
    plain = source.path is not None and source.region is None and _file_tells_axes(source)
    frames = f"{source.path!r}" if plain else _burst_call(source)
    lines = [frames, *(f"{name}={value!r}" for name, value in choices.items())]
    if bundle is not None:
        lines.append(f"calibration={bundle.words}" if bundle.path is None else f"bundle={bundle.path!r}")
    if before:
        lines.append("initial=result")
    imports = "reconstruct" if plain else "Burst, reconstruct"
    body = "\n".join(f"    {line}," for line in lines)
    call = f"result = reconstruct(\n{body}\n)\n"
    return f'{before}from napari_fiberburst import {imports}\n\n{call}result.save("image.ome.tif")\n'


def as_command(source: BurstSource, choices: Mapping[str, Any], bundle: BundleSource | None = None) -> str:
    """Return the command line that does what the form is set to do.

    What is in no file comes first: the command that simulates a burst, or a remark on what to save.
    """
    path = source.path
    lines = []
    if path is None and source.recipe:
        path = "simulated.burst"
        options = [word for name, value in source.recipe.items() for word in _option(name, value)]
        lines.append(shlex.join(["fiberburst", "simulate", *options, "-o", path]))
    elif path is None:
        path = "burst.tif"
        lines.append(f"# save layer {source.name!r} as {path} first")
    words = ["fiberburst", "reconstruct", path, "-o", "image.ome.tif"]
    if not _file_tells_axes(source):
        words += ["--axes", source.axes if len(source.names) == 1 else f"C{source.axes}"]
    if source.region is not None:
        (y0, y1), (x0, x1) = source.region
        words += ["--crop", f"{y0}:{y1},{x0}:{x1}"]
    for name, value in choices.items():
        words += _option(name, value)
    if bundle is not None and bundle.path is not None:
        words += ["--bundle", bundle.path]
    elif bundle is not None:
        lines.append(f"# save layer {bundle.name!r} as calibration.tif first")
        words += ["--calibration", "calibration.tif"]
    return "\n".join([*lines, shlex.join(words)]) + "\n"


def _option(name: str, value: object) -> list[str]:
    """Return a setting as the words of a command line."""
    option = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{option}" if value else f"--no-{option}"]
    if isinstance(value, tuple):
        return [f"--{option}", *map(str, value)]
    return [f"--{option}", str(value)]


def _file_tells_axes(source: BurstSource) -> bool:
    """Whether a file with these layers is read with the right axes when nothing is said of them."""
    return (source.axes in ("TYX", "TYXC", "YX", "YXC") and len(source.names) == 1) or bool(source.recipe)


def _burst_call(source: BurstSource) -> str:
    several = len(source.words) > 1
    frames = f"[{', '.join(source.words)}]" if several else source.words[0]
    known: dict[str, Any] = {"axes": f"C{source.axes}" if several else source.axes}
    known |= {"channel_names": source.channel_names} if source.channel_names else {}
    known |= {"times": source.times} if source.times is not None else {}
    known |= {"pixel_size": source.pixel_size, "unit": source.unit} if source.pixel_size is not None else {}
    burst = f"Burst({', '.join([frames, *(f'{name}={value!r}' for name, value in known.items())])})"
    return burst if source.region is None else f"{burst}.crop{source.region!r}"
