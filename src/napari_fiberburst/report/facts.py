"""What pages and figures say of a result: which frames, which sizes, in which unit."""

from typing import Any

from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import OutputError
from napari_fiberburst.results.reconstruction import Reconstruction


def number_used(result: Reconstruction) -> int:
    """Return how many frames the image rests on."""
    return len(result.homographies if result.frames_used is None else result.frames_used)


def field_of(result: Reconstruction) -> tuple[float, float]:
    """Return the size of a frame in pixels, (width, height)."""
    return float(result.acquisition.shape[2]), float(result.acquisition.shape[1])


def extent_of(result: Reconstruction) -> tuple[float, float]:
    """Return how many pixels of a frame the image covers, (width, height)."""
    height, width = result.canvas.shape
    matrix = result.canvas.reference_from_image
    return width * float(matrix[0, 0]), height * float(matrix[1, 1])


def scale_of(result: Reconstruction) -> dict[str, Any]:
    """Return the width of a frame pixel and its unit; pixels where they are not known."""
    size, unit = result.acquisition.pixel_size, result.acquisition.unit
    return {"pixel": 1.0, "unit": "px"} if size is None or unit is None else {"pixel": size[1], "unit": unit}


def in_words(result: Reconstruction, pixels: float) -> str:
    """Return a length in frame pixels and, where it is known, in the unit of the burst."""
    pixel, unit = scale_of(result).values()
    return f"{pixels:.1f} px" if unit == "px" else f"{pixels:.1f} px = {pixels * pixel:.3g} {unit}"


def check_made_from(result: Reconstruction, burst: Burst) -> None:
    """Refuse to show a burst beside a result that was made from another one, as far as shape and levels tell.

    Raises
    ------
    OutputError
        It was.
    """
    made, given = (
        f"{one.shape[0]} frames of {one.shape[1]} x {one.shape[2]} with {one.shape[3]} channels, {one.dtype}, levels "
        f"{one.black_level:g} to {one.white_level:g}"
        for one in (result.acquisition, burst)
    )
    if made != given:
        raise OutputError(f"the result was made from another burst ({made}) than is given ({given}); give that one")
