"""A viewer with the dock in it, and a burst to run; nothing is written to the user's own settings."""

import gc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from napari.components import ViewerModel
from napari.layers import Image
from napari.utils import progress
from npe2 import PluginManifest
from qtpy.compat import isalive
from qtpy.QtCore import QSettings

from napari_fiberburst import Burst, Reconstruction
from napari_fiberburst.pipeline import reconstruct as pipeline
from napari_fiberburst.plugin.bursts import source_of
from napari_fiberburst.plugin.dock import FiberBurstWidget
from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.layers import RunLayers
from napari_fiberburst.plugin.placement import Placement
from napari_fiberburst.plugin.runs import RunsPanel
from napari_fiberburst.results.progress import Progress
from napari_fiberburst.simulation import SimulatedBurst, simulate

MILLISECONDS = 60_000


@pytest.fixture(scope="session", autouse=True)
def _manifests_read_once() -> Iterator[None]:
    """Read the manifests of all plugins once, and not for every window."""
    found = tuple(PluginManifest.discover())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PluginManifest, "discover", lambda paths=(): iter(found))
        yield


@pytest.fixture(scope="session")
def _lasting() -> Iterator[None]:
    """Give back at the end what `_short_collections` has set aside."""
    yield
    gc.unfreeze()


@pytest.fixture(autouse=True)
def _short_collections(_lasting) -> None:
    """Set aside what was there before a test: napari collects all garbage when a layer goes, and looks at all of it."""
    gc.collect()
    gc.freeze()


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


class Remembering:
    """Reconstructs a burst as chosen once in all tests; after that its reports and its result come at once."""

    def __init__(self) -> None:
        self._known: dict[Any, tuple[list[Progress], Reconstruction]] = {}
        self._make = pipeline.reconstruct

    def __call__(self, burst: Burst, *, bundle: Any, initial: Any, on_progress: Any, **given: Any) -> Reconstruction:
        steered = {name: given.pop(name) for name in ("control", "should_stop")}
        if bundle is not None or initial is not None:
            return self._make(burst, bundle=bundle, initial=initial, on_progress=on_progress, **steered, **given)
        key = burst.frames.tobytes(), repr(burst.acquisition), repr(sorted(given.items()))
        if key in self._known:
            for report in self._known[key][0]:
                on_progress(report)
        else:
            reports: list[Progress] = []

            def take(report: Progress) -> None:
                reports.append(report)
                on_progress(report)

            self._known[key] = reports, self._make(burst, on_progress=take, **steered, **given)
        result = self._known[key][1]
        return replace(result, image=result.image.copy())


@pytest.fixture(scope="session")
def remembering() -> Remembering:
    """Return what reconstructs each burst once."""
    return Remembering()


@pytest.fixture
def run_through(qtbot, remembering) -> Callable[..., Any]:
    """Return a function that starts the dock, waits for the last layer, and returns the run.

    What another test has run already is not computed again, unless it is asked for afresh.
    """

    def ran(dock: FiberBurstWidget, *, afresh: bool = False) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            if not afresh:
                patch.setattr(pipeline, "reconstruct", remembering)
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
