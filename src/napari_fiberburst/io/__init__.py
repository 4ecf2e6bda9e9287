"""Bursts and recordings in, results out."""

from napari_fiberburst.io.doubled import find_doubled
from napari_fiberburst.io.read import read_burst
from napari_fiberburst.io.sources import open_recording

__all__ = ["find_doubled", "open_recording", "read_burst"]
