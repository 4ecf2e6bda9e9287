"""Bursts in, results out."""

from napari_fiberburst.io.read import read_burst

__all__ = ["read_burst"]
