"""A figure for a paper: a captured frame and the image beside it, at the same scale and contrast."""

import math
import textwrap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.picture import as_picture, limits_of
from napari_fiberburst.io.results import check_place, write_whole
from napari_fiberburst.report.facts import check_made_from, extent_of, field_of, in_words, number_used, scale_of
from napari_fiberburst.report.figures import round_below
from napari_fiberburst.report.sheet import PngSheet, Sheet, SvgSheet
from napari_fiberburst.results.reconstruction import Reconstruction

_ENDINGS = (".png", ".svg")
# In units of the sheet, which is as wide as two columns of a journal; letters are of 8 points then.
_WIDTH, _MARGIN, _GAP = 1000, 10, 16
_SIZE, _LINE = 16.0, 22.0
# Letters are at most so wide on average, in sizes, in each of the sheet's fonts.
_LETTER = 0.53
# A scale bar takes at most this part of the narrower picture's width.
_BAR_PART = 0.3
# Dots to a unit: so many at least, and no more, however many pixels the image has.
_LEAST_DOTS, _MOST_DOTS = 2, 6


def check_figure(path: str | Path) -> Path:
    """Refuse a path that a figure should not be written to; before a long run rather than after it.

    Raises
    ------
    OutputError
        The ending is not .png or .svg, or the folder does not exist or cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in _ENDINGS:
        raise OutputError(f"a figure is written to a file ending in .png or .svg; got {target}")
    check_place(target)
    return target


def write_figure(result: Reconstruction, burst: Burst, path: str | Path) -> Path:
    """Write a captured frame and the image beside it as a figure, with scale bars and a caption.

    The frame is the one that the image lies over. Both are at the same scale and contrast. The caption says how many
    frames were used, the resolution and the verdict. The figure is as wide as two columns of a journal (169 mm).

    Parameters
    ----------
    result : Reconstruction
        What is shown.
    burst : Burst
        That it was made from.
    path : str or Path
        A file ending in ``.png`` (300 dots an inch, or more where the image has more pixels) or ``.svg`` (whose words
        stay words, and which can be scaled).

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    OutputError
        The ending is neither of these, or the folder does not exist or cannot be written; or the result was made from
        another burst.
    """
    target = check_figure(path)
    check_made_from(result, burst)
    frame = burst.in_original_units(burst.frames[result.reference])
    extents = field_of(result), extent_of(result)
    limits = _limits(frame, result.image)
    unit = (_WIDTH - 2 * _MARGIN - _GAP) / (extents[0][0] + extents[1][0])
    top = _MARGIN + _LINE
    foot = top + unit * max(height for _, height in extents)
    caption = textwrap.wrap(_caption(result, limits), int((_WIDTH - 2 * _MARGIN) / (_LETTER * _SIZE)))
    height = math.ceil(foot + (len(caption) + 0.5) * _LINE + _MARGIN)
    dots = math.ceil(result.canvas.shape[1] / (unit * extents[1][0]))
    sheet: Sheet = (
        SvgSheet(_WIDTH, height)
        if target.suffix.lower() == ".svg"
        else PngSheet(_WIDTH, height, min(max(dots, _LEAST_DOTS), _MOST_DOTS))
    )
    left = float(_MARGIN)
    heads = f"a   frame {result.reference}, as recorded", "b   reconstructed"
    for image, head, extent in zip((frame, result.image), heads, extents, strict=True):
        sheet.words(head, left, _MARGIN + 0.75 * _LINE, _SIZE)
        sheet.picture(as_picture(image, limits), left, top, unit * extent[0], unit * extent[1])
        _add_scale_bar(sheet, result, left, top + unit * extent[1], unit)
        left += unit * extent[0] + _GAP
    for number, line in enumerate(caption, 1):
        sheet.words(line, _MARGIN, foot + (number + 0.25) * _LINE, _SIZE)
    with write_whole(target) as stream:
        stream.write(sheet.encoded())
    return target


def _add_scale_bar(sheet: Sheet, result: Reconstruction, left: float, foot: float, unit: float) -> None:
    """Add a scale bar to the picture with this left lower corner, `unit` units to a frame pixel."""
    pixel, of = scale_of(result).values()
    length = _bar(result)
    sheet.scale_bar(f"{length:g} {of}", left + 0.7 * _SIZE, foot - 0.7 * _SIZE, unit * length / pixel, _SIZE)


def _bar(result: Reconstruction) -> float:
    """Return the length of both scale bars, in the unit of the burst."""
    return round_below(_BAR_PART * min(field_of(result)[0], extent_of(result)[0]) * scale_of(result)["pixel"])


def _limits(*images: NDArray[np.float32]) -> tuple[float, float]:
    """Return the intensities that are shown black and white: all that any of the images shows by itself."""
    lows, highs = zip(*(limits_of(image) for image in images), strict=True)
    return min(lows), max(highs)


def _caption(result: Reconstruction, limits: tuple[float, float]) -> str:
    frames, _, _, channels = result.acquisition.shape
    shown = "" if channels in (1, 3) else f", the mean of {channels} channels"
    said = [
        f"(a) Frame {result.reference} of a burst of {frames} as it was recorded, (b) the image reconstructed from "
        f"{number_used(result)} of them{shown}; both at the same scale and contrast, {limits[0]:.4g} to "
        f"{limits[1]:.4g}.",
        f"Scale bars: {_bar(result):g} {scale_of(result)['unit']}.",
    ]
    if result.resolution is not None:
        said.append(f"Resolution by two halves of the burst: {in_words(result, result.resolution)}.")
    said.append("Verdict: not judged." if result.quality is None else f"Verdict: {result.quality}.")
    return " ".join(said)
