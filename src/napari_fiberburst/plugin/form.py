"""The form of a run's settings: made from the settings themselves, showing only what applies."""

from collections.abc import Mapping
from typing import Any

from qtpy.QtCore import Qt, Signal
from qtpy.QtGui import QStandardItemModel
from qtpy.QtWidgets import QComboBox, QFormLayout, QLabel, QVBoxLayout, QWidget

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.plugin.back import ChoiceRow
from napari_fiberburst.plugin.parameter_rows import ParameterRow
from napari_fiberburst.plugin.sections import form_layout, section
from napari_fiberburst.settings import (
    ENCODING_NAMES,
    PRESETS,
    Settings,
    all_keywords,
    choice_docs,
    choose,
)

# Shown at once, in this order; all else is of the method, in the section below, where some come first; but for what the
# plugin itself decides, and the result card turns.
_FIRST = ("smoothness", "upsample", "canvas", "fill", "iterations", "time_budget", "device")
_METHOD_FIRST = ("sigma", "learning_rate")
_NOT_SHOWN = ("preview_every", "leave_out", "memory")
_LIVE = ("sigma", "learning_rate")
_BOLD = "font-weight: bold;"
_DEVICES = ("auto", "cpu", "cuda", "mps")
_PRESET_TEXTS = {
    "auto": "The burst calibrates its own bundle; seconds.",
    "paper": "The published method, without a bundle model; minutes to hours.",
}


class SettingsForm(QWidget):
    """Preset, motion, encoding and every parameter that applies to them.

    Attributes
    ----------
    problem : str
        What is wrong with the choices; "" where nothing is.
    """

    changed = Signal()
    turned_live = Signal(str, object)  # a parameter that a running fit follows, and its value

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.problem = ""
        self._usual: Mapping[str, Any] = {}
        self._named = {name: ChoiceRow(name) for name in ("preset", "motion", "encoding", "device")}
        self._preset, self._motion, self._encoding, self._device = (row.box for row in self._named.values())
        self._device.addItems(_DEVICES)
        parameters = all_keywords()
        self._device.setToolTip(parameters.pop("device").doc)
        self._rows = {
            name: ParameterRow(parameter, self) for name, parameter in parameters.items() if name not in _NOT_SHOWN
        }
        self._first, self._method = form_layout(), form_layout()
        self._settings = PRESETS["auto"]
        self._is_running = False
        self._lay_out()
        self._fill("auto", {})
        self._connect()

    @property
    def rows(self) -> Mapping[str, ParameterRow]:
        """The parameters' rows by name, also of those that do not apply."""
        return self._rows

    @property
    def boxes(self) -> Mapping[str, QComboBox]:
        """Where preset, motion, encoding and device are chosen."""
        return {name: row.box for name, row in self._named.items()}

    @property
    def marked(self) -> set[str]:
        """Names of what is marked as away from its default."""
        rows: dict[str, ChoiceRow | ParameterRow] = {**self._named, **{name: self._rows[name] for name in self.shown}}
        return {name for name, row in rows.items() if not row.back.isHidden()}

    @property
    def shown(self) -> set[str]:
        """Names of the parameters that apply: those whose rows can be seen."""
        return {
            name
            for name, row in self._rows.items()
            if any(layout.indexOf(row) >= 0 and layout.isRowVisible(row) for layout in (self._first, self._method))
        }

    @property
    def preset(self) -> str:
        """The preset's name."""
        return self._preset.currentText()

    def choices(self) -> dict[str, Any]:
        """Return what `napari_fiberburst.reconstruct` takes by name to do as the form says, and no more than needed.

        Raises
        ------
        SettingsError
            The choices do not go together.
        """
        preset = PRESETS[self.preset]
        named: dict[str, Any] = {} if self.preset == next(iter(PRESETS)) else {"preset": self.preset}
        observation = self._rows["observation"].value
        if observation != preset.value_of("observation"):
            named["observation"] = observation
        start = choose(**{"preset": self.preset, **named})
        for part, box in (("motion", self._motion), ("encoding", self._encoding)):
            if box.currentText() != start.flat()[part]:
                named[part] = box.currentText()
        base = choose(**named)
        values = {name: self._value(name) for name in base.parameters if name not in (*_NOT_SHOWN, "observation")}
        turned = {name: value for name, value in values.items() if value is not None and value != base.value_of(name)}
        choose(**named, **turned)
        return {**named, **turned}

    def set_choices(self, choices: Mapping[str, Any]) -> None:
        """Show choices as `choices` returned them; those this version does not know are left out."""
        preset = choices.get("preset", next(iter(PRESETS)))
        known = {name: value for name, value in choices.items() if name != "preset"}
        try:
            choose(preset, **known)
        except SettingsError:
            preset, known = next(iter(PRESETS)), {}
        self._fill(preset, known)
        self.changed.emit()

    def take_usual(self, usual: Mapping[str, Any]) -> None:
        """Take the user's preferences, as `choices` returns them, for the defaults."""
        self._usual = usual
        self._mark()

    def show_chosen(self, settings: Settings) -> None:
        """Say what a run has chosen for parameters that were left open."""
        for name, row in self._rows.items():
            if row.parameter.optional and name in settings.parameters:
                row.show_chosen(settings.value_of(name))

    def set_running(self, is_running: bool, *, is_network: bool = False) -> None:
        """Lock all but what a running fit follows; sigma and the learning rate are a network's."""
        self._is_running = is_running
        for choice in self._named.values():
            choice.setEnabled(not is_running)
        for name, row in self._rows.items():
            row.setEnabled(not is_running or (name in _LIVE and is_network))

    def show_devices(self, missing: Mapping[str, str]) -> None:
        """Lock the devices that are not on this machine, and say why: {name: reason}."""
        model = self._device.model()
        assert isinstance(model, QStandardItemModel)  # a combo box's own
        for number, name in enumerate(_DEVICES):
            item = model.item(number)
            assert item is not None
            item.setEnabled(name not in missing)
            item.setToolTip(missing.get(name, ""))

    def _lay_out(self) -> None:
        texts = {(part, name): text for part, name, text in choice_docs()}
        for box, part, names in (
            (self._preset, "preset", PRESETS),
            (self._motion, "motion", ()),
            (self._encoding, "encoding", ENCODING_NAMES),
        ):
            for name in names:
                box.addItem(name)
                tip = _PRESET_TEXTS[name] if part == "preset" else texts[part, name]
                box.setItemData(box.count() - 1, tip, Qt.ItemDataRole.ToolTipRole)
        self._preset.setToolTip("Where settings start from; choosing one sets everything back to it.")
        self._motion.setToolTip("How the object moves between frames.")
        self._encoding.setToolTip("How the scene is held while it is fitted.")
        rows: dict[str, QWidget] = {**self._rows, **self._named}
        others = [name for name in self._rows if name not in (*_FIRST, *_METHOD_FIRST)]
        for layout, order in (
            (self._first, _FIRST),
            (self._method, ("preset", "motion", "encoding", *_METHOD_FIRST, *others)),
        ):
            for name in order:
                layout.addRow(name.replace("_", " "), rows[name])
        method = QWidget()
        method.setLayout(self._method)
        self._hint = QLabel()
        self._hint.setWordWrap(True)
        self._hint.setVisible(False)
        whole = QVBoxLayout(self)
        whole.setContentsMargins(0, 0, 0, 0)
        whole.addLayout(self._first)
        whole.addWidget(self._hint)
        whole.addWidget(section("Method", method))

    def _connect(self) -> None:
        self._preset.currentTextChanged.connect(self._take_preset)
        for box in (self._motion, self._encoding):
            box.currentTextChanged.connect(self._follow)
        self._device.currentTextChanged.connect(self._follow)
        for name, row in self._rows.items():
            row.changed.connect(lambda name=name: self._turn(name))

    def _take_preset(self, name: str) -> None:
        self._fill(name, {})
        self.changed.emit()

    def _turn(self, name: str) -> None:
        if self._is_running:
            self._mark()
            self.turned_live.emit(name, self._rows[name].value)
        else:
            self._follow()

    def _follow(self, *_: Any) -> None:
        """Show what applies now, and whether it goes together."""
        named = {"motion": self._motion.currentText(), "encoding": self._encoding.currentText()}
        observation = self._rows["observation"].value
        try:
            if (observation == "frames") != (self._settings.value_of("observation") == "frames"):
                # The other family of motions comes with its own values.
                self._show(choose(self.preset, observation=observation))
            else:
                # From the preset: what was set once and is left open again must not come back.
                base = choose(self.preset, observation=observation, **named)
                before = self._settings.flat()
                if any(before[part] != chosen for part, chosen in named.items()):
                    self._show(choose(base, **self._shared(base)))
            self.choices()
            self.problem = ""
        except SettingsError as error:
            self.problem = str(error)
        self._hint.setText(self.problem)
        self._hint.setVisible(bool(self.problem))
        self._mark()
        self.changed.emit()

    def _shared(self, base: Settings) -> dict[str, Any]:
        """Return what the form says of the parameters that both the old and the new choice have."""
        known = [name for name in base.parameters if name in self._settings.parameters and name not in _NOT_SHOWN]
        return {name: self._value(name) for name in known if name != "observation"}

    def _fill(self, preset: str, choices: Mapping[str, Any]) -> None:
        self._preset.blockSignals(True)
        self._preset.setCurrentText(preset)
        self._preset.blockSignals(False)
        self._show(choose(preset, **choices))
        self.problem = ""
        self._hint.setVisible(False)

    def _show(self, settings: Settings) -> None:
        """Take the form to settings, and show only their parameters."""
        self._settings = settings
        flat = settings.flat()
        for box in (self._motion, self._encoding, self._device):
            box.blockSignals(True)
        self._motion.clear()
        texts = {name: text for part, name, text in choice_docs() if part == "motion"}
        for name in settings.motions:
            self._motion.addItem(name)
            self._motion.setItemData(self._motion.count() - 1, texts.get(name, ""), Qt.ItemDataRole.ToolTipRole)
        self._motion.setCurrentText(flat["motion"])
        self._encoding.setCurrentText(flat["encoding"])
        if self._device.findText(settings.device) < 0:
            self._device.addItem(settings.device)
        self._device.setCurrentText(settings.device)
        for box in (self._motion, self._encoding, self._device):
            box.blockSignals(False)
        for layout in (self._first, self._method):
            for number in range(layout.rowCount()):
                item = layout.itemAt(number, QFormLayout.ItemRole.FieldRole)
                row = None if item is None else item.widget()
                if isinstance(row, ParameterRow):
                    layout.setRowVisible(number, row.parameter.name in settings.parameters)
        base = self._base()
        for name in settings.parameters:
            if name in self._rows:
                self._rows[name].set_value(flat[name])
                self._rows[name].allow_open(base.value_of(name) is None)
        self._mark()

    def _base(self) -> Settings:
        """Return the settings of a form on which motion and encoding, but nothing else, have been chosen."""
        flat = self._settings.flat()
        return choose(self.preset, **{name: flat[name] for name in ("observation", "motion", "encoding")})

    def _mark(self) -> None:
        """Mark each row whose value is not its default."""
        base, start = self._base(), choose(self.preset, observation=self._settings.value_of("observation"))
        fitting = choose(start, encoding=self._settings.flat()["encoding"])  # networks have no motion "auto"
        defaults = {name: base.value_of(name) for name in base.parameters}
        defaults |= {"observation": PRESETS[self.preset].value_of("observation"), "preset": next(iter(PRESETS))}
        defaults |= {"motion": fitting.flat()["motion"], "encoding": start.flat()["encoding"], **self._usual}
        rows: dict[str, ChoiceRow | ParameterRow] = {**self._rows, **self._named}
        for name, row in rows.items():
            if name in defaults:
                row.compare(defaults[name])
                label = (self._first if name in _FIRST else self._method).labelForField(row)
                assert label is not None  # every row has one
                label.setStyleSheet("" if row.back.isHidden() else _BOLD)

    def _value(self, name: str) -> Any:
        return self._device.currentText() if name == "device" else self._rows[name].value
