"""One clean, sharper image from a burst of frames through a fibre bundle.

The public names load on first use, so that importing the package costs neither torch nor Qt.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from napari_fiberburst import quality as quality
    from napari_fiberburst import settings as settings
    from napari_fiberburst import simulation as simulation
    from napari_fiberburst.bundle.bundle import Bundle as Bundle
    from napari_fiberburst.bundle.calibrate import calibrate as calibrate
    from napari_fiberburst.bundle.samples import Samples as Samples
    from napari_fiberburst.bundle.samples import sample as sample
    from napari_fiberburst.control import Control as Control
    from napari_fiberburst.data.burst import Burst as Burst
    from napari_fiberburst.data.source import FrameSource as FrameSource
    from napari_fiberburst.errors import FiberBurstError as FiberBurstError
    from napari_fiberburst.io import find_doubled as find_doubled
    from napari_fiberburst.io import open_recording as open_recording
    from napari_fiberburst.io import read_burst as read_burst
    from napari_fiberburst.live.engine import LiveEngine as LiveEngine
    from napari_fiberburst.live.view import LiveView as LiveView
    from napari_fiberburst.motion.register import refine as refine
    from napari_fiberburst.motion.register import register as register
    from napari_fiberburst.motion.registration import Registration as Registration
    from napari_fiberburst.networks.saved import load as load
    from napari_fiberburst.pipeline.choose import best_burst as best_burst
    from napari_fiberburst.pipeline.diagnose import diagnose as diagnose
    from napari_fiberburst.pipeline.reconstruct import iterate as iterate
    from napari_fiberburst.pipeline.reconstruct import reconstruct as reconstruct
    from napari_fiberburst.pipeline.remeasure import flatten as flatten
    from napari_fiberburst.pipeline.remeasure import remeasure as remeasure
    from napari_fiberburst.pipeline.render import render as render
    from napari_fiberburst.recordings.mosaic import mosaic as mosaic
    from napari_fiberburst.recordings.video import video as video
    from napari_fiberburst.report import write_figure as write_figure
    from napari_fiberburst.report import write_report as write_report
    from napari_fiberburst.results.diagnostics import Diagnostics as Diagnostics
    from napari_fiberburst.results.progress import Progress as Progress
    from napari_fiberburst.results.reconstruction import Reconstruction as Reconstruction
    from napari_fiberburst.scene.solve import Scene as Scene
    from napari_fiberburst.scene.solve import solve as solve
    from napari_fiberburst.settings import Settings as Settings

__version__ = "0.1.0"

_HOMES = {
    "Bundle": "bundle.bundle",
    "Burst": "data.burst",
    "Control": "control",
    "Diagnostics": "results.diagnostics",
    "FiberBurstError": "errors",
    "FrameSource": "data.source",
    "LiveEngine": "live.engine",
    "LiveView": "live.view",
    "Progress": "results.progress",
    "Reconstruction": "results.reconstruction",
    "Registration": "motion.registration",
    "Samples": "bundle.samples",
    "Scene": "scene.solve",
    "Settings": "settings",
    "best_burst": "pipeline.choose",
    "calibrate": "bundle.calibrate",
    "diagnose": "pipeline.diagnose",
    "find_doubled": "io",
    "flatten": "pipeline.remeasure",
    "iterate": "pipeline.reconstruct",
    "load": "networks.saved",
    "mosaic": "recordings.mosaic",
    "open_recording": "io",
    "read_burst": "io",
    "reconstruct": "pipeline.reconstruct",
    "refine": "motion.register",
    "register": "motion.register",
    "remeasure": "pipeline.remeasure",
    "render": "pipeline.render",
    "sample": "bundle.samples",
    "solve": "scene.solve",
    "video": "recordings.video",
    "write_figure": "report",
    "write_report": "report",
}

_MODULES = ("quality", "settings", "simulation")

__all__ = sorted([*_HOMES, *_MODULES])


def __getattr__(name: str) -> object:
    """Import a public name from its module the first time it is asked for (PEP 562)."""
    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
