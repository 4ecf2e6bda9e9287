"""One image out of a burst: set it, watch it resolve, see what came of it."""

import atexit
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Any, ClassVar

from napari.utils.notifications import show_error
from qtpy.QtWidgets import QLabel, QPushButton, QVBoxLayout, QWidget
from superqt.utils import create_worker

from napari_fiberburst.errors import FiberBurstError, SettingsError
from napari_fiberburst.plugin import METADATA_KEY
from napari_fiberburst.plugin.budget import in_words, refuse_what_cannot_fit
from napari_fiberburst.plugin.bundles import BundleSource
from napari_fiberburst.plugin.bursts import BurstSource
from napari_fiberburst.plugin.calls import as_python
from napari_fiberburst.plugin.copying import CopyButtons
from napari_fiberburst.plugin.departures import Departures
from napari_fiberburst.plugin.display import AnimationThrottle, Display
from napari_fiberburst.plugin.favouring import RegionWatch
from napari_fiberburst.plugin.form import SettingsForm
from napari_fiberburst.plugin.input_box import InputBox
from napari_fiberburst.plugin.job import Job, load_solver
from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.layers import RunLayers
from napari_fiberburst.plugin.placement import Placement
from napari_fiberburst.plugin.pointing import Pointing
from napari_fiberburst.plugin.preferences import preferences, remember, remembered, usual
from napari_fiberburst.plugin.runner import Runner, wait_for_workers
from napari_fiberburst.plugin.runs import RunsPanel
from napari_fiberburst.plugin.sections import row_of, section
from napari_fiberburst.plugin.tasks.task import Task
from napari_fiberburst.settings import SplineMethod, choose

if TYPE_CHECKING:
    import napari
    from napari.layers import Layer

    from napari_fiberburst.control import Region
    from napari_fiberburst.results.progress import Progress

# As little as tells rows apart: with a doubtful run and a second one, what is done most is in sight at 1280 x 800.
_SPACING = 3


class PictureTask(Task):
    """Reconstructs the burst that is chosen, by `napari_fiberburst.reconstruct`, in another thread."""

    title: ClassVar[str] = "Picture"
    tip: ClassVar[str] = "Turn the burst into one clean image."

    def __init__(self, viewer: "napari.viewer.Viewer", source: InputBox, parent: QWidget | None = None) -> None:
        super().__init__(viewer, source, parent)
        self._shown_at_end = "image"
        self._run: KeptRun | None = None
        self._missing: dict[str, str] | None = None
        self._throttle = AnimationThrottle()
        self._is_network = False
        self.form = SettingsForm()
        self.runner = Runner(self)
        self.runs = RunsPanel(viewer)
        self.display = Display(viewer, self)
        self._regions = RegionWatch(viewer, self._favour)
        self._pointing = Pointing(viewer, lambda: self.runs.runs)
        self.pause_button = QPushButton("Pause")
        self.stop_button = QPushButton("Stop")
        self._memory = QLabel()
        self.copying = CopyButtons(self.input, self.form)
        self.departures = Departures()
        self._burst: Layer | None = None
        self._preferences = preferences()
        self.form.take_usual(usual(self._preferences))
        self.form.set_choices(remembered(self._preferences))
        self._lay_out()
        self._connect()
        self._follow_state("ready")
        self._follow_runs()
        self._take_input()
        self.departures.begin_anew()
        self._warm_up()

    @property
    def is_empty(self) -> bool:
        """Whether no run is kept."""
        return self.runs.is_empty

    def start(self) -> None:
        """Run what the form says. Does nothing while a run is going."""
        if self.runner.state != "ready":
            return
        try:
            source, choices = self.input.source(), self.form.choices()
            refuse_what_cannot_fit(source, choices, self._missing)
        except FiberBurstError as error:
            show_error(str(error))
            return
        placement = self.input.placement(source)
        self._begin(source, choices, placement, bundle=self.input.bundle_source())

    def continue_run(self, run: KeptRun, steps: int) -> None:
        """Take a network's fit some steps further, as a run of its own."""
        if self.runner.state == "ready" and run.result is not None:
            choices = {"iterations": steps}
            self._begin(run.source, choices, run.layers.placement, bundle=run.bundle, after=run)

    def start_on(self, layer: "Layer", show: str = "image") -> None:
        """Reconstruct a layer with the form as it is, and show the image or the stabilised burst in the end."""
        if self.runner.state != "ready":
            show_error("a run is going; stop it, or wait for its end, before the next one")
        elif layer not in self.input.burst.choices:
            show_error(f"layer {layer.name!r} is no image that could be a burst; select the layer with the frames")
        else:
            self.input.burst.value = layer
            self.start()
            self._shown_at_end = show

    def shut_down(self) -> None:
        """Stop what is running and let go of the viewer. May be called more than once."""
        self.runs.compare.stop()
        _let_go(self.runner, self.display, self._throttle, self._pointing)
        self._follow_state("ready")

    def open(self) -> None:
        """Follow the viewer, again where the dock was closed."""
        self.display.open()
        self._pointing.open()

    def _begin(
        self,
        source: BurstSource,
        choices: dict[str, Any],
        placement: Placement,
        *,
        bundle: BundleSource | None = None,
        after: KeptRun | None = None,
    ) -> None:
        name = self._new_name()
        python = as_python(source, choices, bundle, before="" if after is None else after.python)
        metadata = {"run": name, "burst": source.name, "choices": choices, "python": python}
        initial = None if after is None else after.result
        settings = choose(**choices) if initial is None else initial.settings
        self._is_network = not isinstance(settings.method, SplineMethod)
        self._preferences = preferences()
        self.form.take_usual(usual(self._preferences))
        layers = RunLayers(self._viewer, name, placement, metadata)
        job = Job(
            source,
            {**choices, "preview_every": 1 / self._preferences.previews_per_second},
            bundle=None if bundle is None else bundle.given,
            initial=initial,
        )
        self._run = KeptRun(
            name=name, python=python, source=source, choices=choices, layers=layers, bundle=bundle, curve=job.curve
        )
        self._shown_at_end = "image"
        self.display.begin()
        self.runs.add(self._run)
        self._follow_runs()
        self.runner.start(job, f"{name} of {source.name}")
        if self._is_network:
            self._regions.begin(source)

    def _show(self, report: "Progress") -> None:
        job, run = self.runner.job, self._run
        if job is not None and run is not None:
            self.form.show_chosen(report.settings)
            self.display.report(run, job, report)

    def _show_preview(self, report: "Progress") -> None:
        if self.runner.job is not None and self._run is not None:
            self.display.preview(self._run, self.runner.job, report)

    def _keep(self, job: Job) -> None:
        """Take over the result of a run."""
        if self._run is not None and job.result is not None:
            if self._run.bundle is not None:
                self._run.bundle = replace(self._run.bundle, bundle=job.bundle)
            self.form.show_chosen(job.result.settings)
            self.display.end(self._run, job)
            self.runs.refresh()

    def _show_what_was_asked(self, run: KeptRun) -> None:
        """Show something else of a result than its image, where that was asked for."""
        if run is self._run and self._shown_at_end != "image":
            run.layers.switch(self._shown_at_end, True)
            self.display.card.refresh()
            run.layers.set_visible("image", False)

    def _fail(self, problem: str) -> None:
        """Say why a run came to nothing."""
        run = self._run
        if run is not None:
            self.runs.remove(run)
        self.display.fail("The run" if run is None else run.name, problem)
        show_error(problem)

    def _forget(self, run: KeptRun) -> None:
        if run is self._run:
            self._run = None
        self._follow_runs()

    def _follow_runs(self) -> None:
        """Show what is kept of runs once there are any."""
        for widget in (self.display.curve_box, self.runs, self.display.past_box):
            widget.setVisible(not self.is_empty)
        self.kept_changed.emit()

    def _follow_state(self, state: str) -> None:
        """Offer what can be done now."""
        is_ready = state == "ready"
        if is_ready:
            self._regions.end()
            self._throttle.restore()
        else:
            self._throttle.slow(self.window() or self)
        self.start_button.setEnabled(is_ready)
        self.pause_button.setEnabled(state in ("running", "paused"))
        self.pause_button.setText("Continue" if state == "paused" else "Pause")
        self.stop_button.setEnabled(state in ("running", "paused"))
        self.input.set_enabled(is_ready)
        self.departures.set_enabled(is_ready)
        self.form.set_running(not is_ready, is_network=self._is_network)
        self.runs.set_running(not is_ready)
        self.display.slider.setEnabled(is_ready)
        self.display.bar.setVisible(not is_ready)
        if state == "paused":
            self.display.status.setText("paused")
        elif state == "stopping":
            self.display.status.setText("stopping; what there is will be kept")

    def _toggle_pause(self) -> None:
        if self.runner.state == "paused":
            self.runner.resume()
        else:
            self.runner.pause()

    def _turn_live(self, name: str, value: Any) -> None:
        """Hand a changed sigma or learning rate to the running fit."""
        job, run = self.runner.job, self._run
        if job is None or run is None:
            return
        if value is None:
            self.display.status.setText(f"{name.replace('_', ' ')} will be auto in the next run")
            return
        try:
            setattr(job.control, name, value)
        except SettingsError as error:
            show_error(str(error))
            return
        run.note_turned(name, value)

    def _favour(self, region: "Region | None") -> None:
        """Let the running fit learn a region first that was drawn just now."""
        job, run = self.runner.job, self._run
        if job is not None and run is not None:
            job.control.region = region
            run.note_turned("region", region)
            self.display.status.setText("the region drawn is learned first" if region else "no region is favoured")

    def _take_input(self) -> None:
        if self.input.burst.value is not self._burst:
            self._burst = self.input.burst.value
            self.departures.begin_anew()
        self._estimate()

    def _set_back(self) -> None:
        self.form.set_choices(usual(self._preferences))

    def _estimate(self) -> None:
        """Say how much memory the run will take, and keep the choices."""
        self._memory.setText("")
        with suppress(FiberBurstError):
            choices = self.form.choices()
            self.departures.take_choices(choices, usual(self._preferences))
            remember(choices, self._preferences)
            self._memory.setText(in_words(self.input.source(), choices, self._missing))

    def _new_name(self) -> str:
        """Return the first name that no run of this viewer has."""
        taken = {layer.metadata.get(METADATA_KEY, {}).get("run") for layer in self._viewer.layers}
        for task in (self.window() or self).findChildren(PictureTask):  # a run may have no layer yet
            taken |= {run.name for run in task.runs.runs}
        return next(name for number in count(1) if (name := f"run {number}") not in taken)

    def _warm_up(self) -> None:
        """Load torch in the background, which takes seconds, and learn which devices there are.

        The worker is superqt's, because napari shows its own as activity and asks before it closes.
        """
        atexit.register(wait_for_workers)
        create_worker(load_solver, _connect={"returned": self._take_missing}, _ignore_errors=True)

    def _take_missing(self, missing: dict[str, str]) -> None:
        self._missing = missing
        self.form.show_devices(missing)

    def _lay_out(self) -> None:
        self.start_button.setToolTip("Reconstruct the burst; everything sets itself.")
        self.stop_button.setToolTip("End the run; what it has come to is kept.")
        self.pause_button.setToolTip("Hold the run where it is.")
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(_SPACING)
        column.addWidget(self.departures)
        column.addLayout(row_of(self.start_button, self.pause_button, self.stop_button))
        column.addWidget(self.display.status_box)
        column.addWidget(self.display.card)
        column.addWidget(section("Settings", self._settings()))
        column.addWidget(self.display.curve_box)
        column.addWidget(self.runs)
        column.addWidget(self.display.past_box)

    def _settings(self) -> QWidget:
        """Return what most runs need nothing of."""
        settings = QWidget()
        column = QVBoxLayout(settings)
        column.setContentsMargins(0, 0, 0, 0)
        for widget in (self.form, self._memory, self.copying):
            column.addWidget(widget)
        return settings

    def _connect(self) -> None:
        self.start_button.clicked.connect(lambda: self.start())
        self.pause_button.clicked.connect(self._toggle_pause)
        self.stop_button.clicked.connect(self.runner.stop)
        self.copying.copied.connect(self.display.status.setText)
        self.input.changed.connect(self._take_input)
        self.departures.back_asked.connect(self._set_back)
        self.form.changed.connect(self._estimate)
        self.form.turned_live.connect(self._turn_live)
        self.runs.chosen.connect(self.display.select)
        self.runs.charted.connect(self.display.chart)
        self.runs.removed.connect(self._forget)
        self.runs.continue_asked.connect(self.continue_run)
        self.runner.reported.connect(self._show)
        self.runner.previewed.connect(self._show_preview)
        self.runner.finished.connect(self._keep)
        self.runner.stopped.connect(self._keep)
        self.runner.failed.connect(self._fail)
        self.runner.state_changed.connect(self._follow_state)
        self.display.complete.connect(self._show_what_was_asked)
        self.display.card.steering.changed.connect(self.runs.refresh)
        # The window can go without a word to this widget; what is called then must not need it.
        self.destroyed.connect(partial(_let_go, self.runner, self.display, self._throttle, self._pointing))


def _let_go(runner: Runner, display: Display, throttle: AnimationThrottle, pointing: Pointing) -> None:
    throttle.restore()
    pointing.shut()
    runner.shut_down()
    display.shut_down()
