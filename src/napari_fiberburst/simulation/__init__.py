"""Bursts and recordings with ground truth: a scene, a motion, a bundle, a camera. numpy, scipy, a warp of its own."""

from napari_fiberburst.simulation.bundle import Bundle, make_bundle
from napari_fiberburst.simulation.camera import Camera
from napari_fiberburst.simulation.faults import Faults
from napari_fiberburst.simulation.motion import MOTIONS, brownian_motion, handheld_motion, raster_motion
from napari_fiberburst.simulation.paths import PATHS
from napari_fiberburst.simulation.recordings import (
    ENDLESS_SCENES,
    RECORDED_PHYSICS,
    SimulatedRecording,
    simulate_recording,
)
from napari_fiberburst.simulation.scenes import SCENES, Scene, make_scene
from napari_fiberburst.simulation.simulate import SimulatedBurst, simulate
from napari_fiberburst.simulation.slide import Slide

__all__ = [
    "ENDLESS_SCENES",
    "MOTIONS",
    "PATHS",
    "RECORDED_PHYSICS",
    "SCENES",
    "Bundle",
    "Camera",
    "Faults",
    "Scene",
    "SimulatedBurst",
    "SimulatedRecording",
    "Slide",
    "brownian_motion",
    "handheld_motion",
    "make_bundle",
    "make_scene",
    "raster_motion",
    "simulate",
    "simulate_recording",
]
