"""A sheet of paper with pictures, bars and words on it, as PNG or SVG: the same places in both."""

import base64
from functools import cache
from html import escape
from io import BytesIO
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from napari_fiberburst.io.picture import encode_png

# Pillow's own font lacks letters beyond ASCII, such as that of the micrometre, and is the last resort.
_FONTS = ("Arial.ttf", "arial.ttf", "LiberationSans-Regular.ttf", "DejaVuSans.ttf", "Helvetica.ttc")
_FAMILY = "Arial, Helvetica, 'Liberation Sans', 'DejaVu Sans', sans-serif"
# Of the edge around what lies on a picture, in text sizes: it is seen on black and on white.
_EDGE = 0.08
# Units to the inch: a sheet of 1000 units is as wide as two columns of a journal.
_UNITS_PER_INCH = 150


class Sheet(Protocol):
    """Takes parts at places in units, from its left upper corner, and becomes a file in the end."""

    def picture(self, shown: NDArray[np.uint8], x: float, y: float, width: float, height: float) -> None:
        """Add a picture of 8 bits, as `napari_fiberburst.io.picture.as_picture` makes it."""

    def scale_bar(self, words: str, x: float, y: float, width: float, size: float) -> None:
        """Add a bar that stands at a height, and what it stands for above it, in letters of a size."""

    def words(self, words: str, x: float, y: float, size: float) -> None:
        """Add a line of words that stands at a height."""

    def encoded(self) -> bytes:
        """Return the file."""


class SvgSheet:
    """A sheet as SVG: words stay words, and each pixel of a picture stays one.

    Parameters
    ----------
    width, height : float
        In units.
    """

    def __init__(self, width: float, height: float) -> None:
        inches = f'width="{width / _UNITS_PER_INCH:.4g}in" height="{height / _UNITS_PER_INCH:.4g}in"'
        self._parts = [
            '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
            f'{inches} viewBox="0 0 {width:g} {height:g}" font-family="{_FAMILY}">',
            f'<rect width="{width:g}" height="{height:g}" fill="#fff"/>',
        ]

    def picture(self, shown: NDArray[np.uint8], x: float, y: float, width: float, height: float) -> None:
        """Add a picture of 8 bits."""
        # With the older name of the link, because office programs know no other.
        self._parts.append(
            f'<image x="{x:g}" y="{y:g}" width="{width:.6g}" height="{height:.6g}" preserveAspectRatio="none" '
            'style="image-rendering: pixelated" '
            f'xlink:href="data:image/png;base64,{base64.b64encode(encode_png(shown)).decode()}"/>'
        )

    def scale_bar(self, words: str, x: float, y: float, width: float, size: float) -> None:
        """Add a bar that stands at a height, and its words above it."""
        edge = _EDGE * size
        self._parts.append(
            f'<rect x="{x:g}" y="{y - 0.25 * size:g}" width="{width:.6g}" height="{0.25 * size:g}" fill="#fff" '
            f'stroke="#000" stroke-width="{edge / 2:g}"/>'
        )
        # The edge lies below the letters, as an element of its own, because not all programs know `paint-order`.
        for look in (f'fill="#000" stroke="#000" stroke-width="{2 * edge:g}"', 'fill="#fff"'):
            self._parts.append(_text(words, x, y - 0.55 * size, size, look))

    def words(self, words: str, x: float, y: float, size: float) -> None:
        """Add a line of words that stands at a height."""
        self._parts.append(_text(words, x, y, size, 'fill="#000"'))

    def encoded(self) -> bytes:
        """Return the file."""
        return "\n".join([*self._parts, "</svg>\n"]).encode()


class PngSheet:
    """A sheet as PNG.

    Parameters
    ----------
    width, height : float
        In units.
    dots : int
        Pixels to a unit.
    """

    def __init__(self, width: float, height: float, dots: int) -> None:
        self._dots = dots
        self._page = Image.new("RGB", (round(width * dots), round(height * dots)), "white")
        self._pen = ImageDraw.Draw(self._page)

    def picture(self, shown: NDArray[np.uint8], x: float, y: float, width: float, height: float) -> None:
        """Add a picture of 8 bits."""
        size = (max(1, round(width * self._dots)), max(1, round(height * self._dots)))
        drawn = Image.fromarray(shown).convert("RGBA")
        enlarged = size[0] >= drawn.width
        drawn = drawn.resize(size, Image.Resampling.NEAREST if enlarged else Image.Resampling.BOX)
        self._page.paste(drawn, self._at(x, y), drawn)

    def scale_bar(self, words: str, x: float, y: float, width: float, size: float) -> None:
        """Add a bar that stands at a height, and its words above it."""
        edge = max(1, round(_EDGE / 2 * size * self._dots))
        box = (*self._at(x, y - 0.25 * size), *self._at(x + width, y))
        self._pen.rectangle(box, fill="white", outline="black", width=edge)
        self._write(words, x, y - 0.55 * size, size, fill="white", stroke_width=2 * edge, stroke_fill="black")

    def words(self, words: str, x: float, y: float, size: float) -> None:
        """Add a line of words that stands at a height."""
        self._write(words, x, y, size, fill="black")

    def encoded(self) -> bytes:
        """Return the file."""
        encoded = BytesIO()
        per_inch = _UNITS_PER_INCH * self._dots
        self._page.save(encoded, format="PNG", dpi=(per_inch, per_inch))
        return encoded.getvalue()

    def _at(self, x: float, y: float) -> tuple[int, int]:
        return round(x * self._dots), round(y * self._dots)

    def _write(self, words: str, x: float, y: float, size: float, **look: Any) -> None:
        font = _font(round(size * self._dots))
        plain = font is _plain_font(round(size * self._dots))
        self._pen.text(self._at(x, y), words.replace("µ", "u") if plain else words, font=font, anchor="ls", **look)


def _text(words: str, x: float, y: float, size: float, look: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" font-size="{size:g}" {look}>{escape(words)}</text>'


@cache
def _font(pixels: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    for name in _FONTS:
        try:
            return ImageFont.truetype(name, pixels)
        except OSError:
            continue
    return _plain_font(pixels)


@cache
def _plain_font(pixels: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(pixels)
