"""The solver: fit a burst's scene and motion jointly, and report while it happens."""

from napari_fiberburst.solver.progress import Progress
from napari_fiberburst.solver.representation import load
from napari_fiberburst.solver.solve import iterate, reconstruct

__all__ = ["Progress", "iterate", "load", "reconstruct"]
