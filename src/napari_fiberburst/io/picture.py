"""Images as they are looked at: 8 bits, at a contrast that shows them well."""

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from napari_fiberburst.io.results import write_whole

# Per cent of an image's values that are let go below and above, because a few outliers would make it dull.
_DARKEST, _BRIGHTEST = 0.1, 99.9
# Of intensities that are shown black and white, where nothing in an image differs.
_LEAST_SPAN = 1e-30


def limits_of(image: NDArray[np.floating]) -> tuple[float, float]:
    """Return the intensities that are shown black and white, all channels alike; (0, 1) where nothing is known."""
    known = image[np.isfinite(image)]
    if known.size == 0:
        return 0.0, 1.0
    low, high = np.percentile(known, [_DARKEST, _BRIGHTEST])
    return float(low), float(high)


def as_picture(image: NDArray[np.floating], limits: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """Return an image in 8 bits, see-through where it is NaN.

    Parameters
    ----------
    image : numpy.ndarray
        (H, W) or (H, W, C). Three channels are red, green and blue; any other number is shown as their mean, in grey.
    limits : (float, float), optional
        The intensities that are shown black and white; default `limits_of` the image.

    Returns
    -------
    numpy.ndarray
        (H, W) in grey or (H, W, 3) in colour; with one channel more, the opacity, where there is NaN.
    """
    if image.ndim == 3 and image.shape[2] != 3:
        image = image.mean(axis=2)
    low, high = limits_of(image) if limits is None else limits
    known = np.isfinite(image) if image.ndim == 2 else np.isfinite(image).all(axis=2)
    scaled = np.clip((image - low) / max(high - low, _LEAST_SPAN), 0, 1)
    picture: NDArray[np.uint8] = np.rint(255 * np.nan_to_num(scaled)).astype(np.uint8)
    if known.all():
        return picture
    with_opacity: NDArray[np.uint8] = np.dstack([picture, np.where(known, 255, 0).astype(np.uint8)])
    return with_opacity


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture as the bytes of a PNG file."""
    encoded = BytesIO()
    Image.fromarray(picture).save(encoded, format="PNG")
    return encoded.getvalue()


def write_png(path: str | Path, picture: NDArray[np.uint8]) -> Path:
    """Write a picture as a PNG file, whole or not at all.

    Raises
    ------
    OutputError
        The folder does not exist or cannot be written.
    """
    target = Path(path)
    with write_whole(target) as stream:
        stream.write(encode_png(picture))
    return target
