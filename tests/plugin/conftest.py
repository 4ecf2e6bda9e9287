"""A viewer with the dock in it, and a burst to run; nothing is written to the user's own settings."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from napari.components import ViewerModel
from napari.layers import Image
from napari.utils import progress
from qtpy.compat import isalive
from qtpy.QtCore import QSettings

from napari_fiberburst import Reconstruction
from napari_fiberburst.plugin.bursts import source_of
from napari_fiberburst.plugin.dock import FiberBurstWidget
from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.layers import RunLayers
from napari_fiberburst.plugin.placement import Placement
from napari_fiberburst.plugin.runs import RunsPanel
from napari_fiberburst.simulation import SimulatedBurst, simulate

MILLISECONDS = 60_000


@pytest.fixture(autouse=True)
def _own_store(tmp_path, monkeypatch):
    """Keep the form's memory in this test's folder."""
    QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, str(tmp_path))


@pytest.fixture(scope="session")
def simulated() -> SimulatedBurst:
    """Return 8 RGB frames of 63 x 75 pixels, cores 4 pixels apart."""
    return simulate("histology", shape=(63, 75), frames=8, pitch=4.0, seed=3)


@pytest.fixture
def burst_layer(simulated) -> Image:
    """Return the burst as a sample layer has it, its truth in the metadata."""
    arrays = simulated.arrays()
    metadata = {"truth": arrays["truth"], "homographies": arrays["homographies"], "recipe": {"scene": "histology"}}
    return Image(arrays["frames"], rgb=True, name="burst", metadata={"fiberburst": metadata})


@pytest.fixture
def open_dock(make_napari_viewer, qtbot) -> Callable[..., Any]:
    """Return a function that opens a viewer with the dock and these layers; returns both."""
    docks: list[FiberBurstWidget] = []

    def opened(*layers: Image) -> tuple[Any, FiberBurstWidget]:
        viewer = make_napari_viewer()
        for layer in layers:
            viewer.add_layer(layer)
        dock = FiberBurstWidget(viewer)
        docks.append(dock)
        viewer.window.add_dock_widget(dock, name="fiber burst")
        return viewer, dock

    yield opened
    assert not progress._all_instances
    for dock in docks:
        if isalive(dock) and dock.parent() is None:
            dock.deleteLater()  # one that was taken out of its window is nobody else's to delete


@pytest.fixture
def run_through(qtbot) -> Callable[[FiberBurstWidget], Any]:
    """Return a function that starts the dock, waits for the last layer, and returns the run."""

    def ran(dock: FiberBurstWidget) -> Any:
        with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
            dock.picture.start()
        return dock.picture.runs.run

    return ran


@pytest.fixture
def grey_frames(simulated) -> np.ndarray:
    """Return the burst's green channel as it was recorded, (8, 63, 75) uint8."""
    return simulated.arrays()["frames"][..., 1]


@pytest.fixture
def ome_file(tmp_path, simulated) -> Path:
    """Return a file of two channels, half a micrometre by a quarter a pixel, a frame each 0.2 s."""
    path = tmp_path / "recorded.ome.tif"
    told = {
        "axes": "TCYX",
        "PhysicalSizeY": 0.5,
        "PhysicalSizeX": 0.25,
        "TimeIncrement": 0.2,
        "Channel": {"Name": ["red", "green"]},
    }
    tifffile.imwrite(path, simulated.arrays()["frames"][..., :2].transpose(0, 3, 1, 2), metadata=told)
    return path


@pytest.fixture
def kept_run() -> Callable[..., KeptRun]:
    """Return a function that keeps a result of a burst layer as a run, with its image in a viewer."""

    def kept(
        viewer: ViewerModel,
        layers: Sequence[Image],
        axes: str,
        result: Reconstruction,
        name: str = "run 1",
        **source: Any,
    ) -> KeptRun:
        region = source.get("region") or ((0, 0), (0, 0))
        placement = Placement.of(layers, axes, (region[0][0], region[1][0]))
        run = KeptRun(
            name=name,
            python="",
            source=source_of(layers, axes, **source),
            choices={},
            layers=RunLayers(viewer, name, placement, {"run": name}),
        )
        run.result = result
        run.layers.finish(result, run.source.frames)
        return run

    return kept


@pytest.fixture(scope="session")
def grey_result(tiny_simulation, fit):
    """Return a result of grey frames; its image is the tests' to replace."""
    return fit(tiny_simulation.arrays()["frames"][..., 1], iterations=1)


@pytest.fixture(scope="session")
def colour_result(tiny_simulation, fit):
    """Return a result of frames with three channels."""
    return fit(tiny_simulation.arrays()["frames"], iterations=1)


@pytest.fixture
def viewer():
    """Return a viewer without a window."""
    return ViewerModel()


@pytest.fixture
def panel(qtbot, viewer):
    """Return a panel of the runs in it."""
    made = RunsPanel(viewer)
    qtbot.addWidget(made)
    return made
