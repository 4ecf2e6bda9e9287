"""The form says what `reconstruct` is to do, no more, and shows only what applies."""

import pytest
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QLabel, QVBoxLayout, QWidget

from napari_fiberburst.plugin.form import SettingsForm
from napari_fiberburst.plugin.preferences import Preferences, remember, remembered
from napari_fiberburst.plugin.sections import section
from napari_fiberburst.settings import ENCODING_NAMES, MOTIONS, choice_docs, choose


@pytest.fixture
def form(qtbot):
    made = SettingsForm()
    qtbot.addWidget(made)
    made.show()
    return made


def test_a_fresh_form_asks_for_nothing(form):
    assert form.choices() == {}
    assert form.preset == "auto"


@pytest.mark.parametrize(
    "choices",
    [
        {"motion": "affine"},
        {"upsample": 2.0, "canvas": "union"},
        {"smoothness": 0.125},
        {"encoding": "fourier", "sigma": 3.0, "learning_rate": 0.001},
        {"encoding": "hash", "levels": 5, "iterations": 77},
        {"preset": "paper"},
        {"preset": "paper", "sigma": 2.0, "motion": "flow_tv", "tv_weight": 0.5},
        {"observation": "frames", "encoding": "siren"},
        {"motion": "flow", "encoding": "nerf"},
        {"device": "cpu", "fill": True, "seed": 7, "time_budget": 12.5},
    ],
)
def test_the_form_gives_back_what_it_was_set_to(form, choices):
    form.set_choices(choices)
    assert choose(**form.choices()) == choose(**choices)
    assert form.problem == ""


def test_only_what_applies_is_shown(form):
    assert {"smoothness", "upsample", "held_out"} <= form.shown
    assert not {"sigma", "scene_width", "learning_rate", "levels"} & form.shown
    form.set_choices({"encoding": "fourier"})
    assert {"sigma", "features", "scene_width", "learning_rate"} <= form.shown
    assert not {"smoothness", "levels", "motion_width"} & form.shown
    form.set_choices({"preset": "paper"})
    assert "motion_width" in form.shown
    assert "canvas" not in form.shown


@pytest.mark.parametrize("encoding", ENCODING_NAMES)
@pytest.mark.parametrize("motion", MOTIONS)
def test_every_choice_shows_every_parameter_it_has(form, motion, encoding):
    form.boxes["motion"].setCurrentText(motion)
    form.boxes["encoding"].setCurrentText(encoding)
    if form.problem:
        assert "needs a network encoding" in form.problem or "needs encoding 'spline'" in form.problem
        assert form.problem in [label.text() for label in form.findChildren(QLabel) if not label.isHidden()]
    else:
        not_shown = {"preview_every", "device", "leave_out", "memory"}
        wanted = set(choose(motion=motion, encoding=encoding).parameters) - not_shown
        assert form.shown == wanted


def test_a_preset_sets_everything_back(form):
    form.set_choices({"motion": "affine", "upsample": 3.0})
    form.boxes["preset"].setCurrentText("paper")
    assert form.choices() == {"preset": "paper"}
    form.boxes["preset"].setCurrentText("auto")
    assert form.choices() == {}


def go_back(form, name):
    """Press the mark at a setting's row."""
    row = form.rows.get(name) or form.boxes[name].parentWidget()
    assert row.back.accessibleName().startswith(name.replace("_", " "))
    row.back.click()


def test_what_is_not_its_default_is_marked_at_its_row_and_goes_back_at_a_click(form, qtbot):
    assert form.marked == set()
    form.set_choices({"motion": "affine", "upsample": 3.0, "smoothness": 0.125, "device": "cpu"})
    assert form.marked == {"motion", "upsample", "smoothness", "device"}
    for name in ("smoothness", "motion", "device"):
        with qtbot.waitSignal(form.changed):
            go_back(form, name)
    assert form.choices() == {"upsample": 3.0}
    assert form.marked == {"upsample"}
    form.rows["upsample"].editor.value = 1.0
    assert form.marked == set()


def test_defaults_are_those_of_the_preset_and_the_method_that_are_chosen(form):
    form.set_choices({"preset": "paper"})
    assert form.marked == {"preset"}
    form.boxes["encoding"].setCurrentText("siren")
    assert form.marked == {"preset", "encoding"}, "what comes with an encoding is its own default"
    form.rows["omega_0"].editor.value = 7.5
    assert form.marked == {"preset", "encoding", "omega_0"}
    go_back(form, "omega_0")
    go_back(form, "encoding")
    go_back(form, "preset")
    assert form.choices() == {}
    form.take_usual({"preset": "paper", "device": "cpu"})
    assert form.marked == {"preset", "device"}


def test_choices_that_do_not_go_together_have_a_way_back(form):
    form.boxes["motion"].setCurrentText("flow")
    form.boxes["encoding"].setCurrentText("spline")
    assert form.problem
    assert "motion" in form.marked
    go_back(form, "motion")
    assert form.problem == ""


def test_tooltips_are_the_settings_own_words(form):
    parameter = choose().parameters["upsample"]
    assert parameter.doc in form.rows["upsample"].toolTip()
    tips = [
        form.boxes["encoding"].itemData(row, Qt.ItemDataRole.ToolTipRole)
        for row in range(form.boxes["encoding"].count())
    ]
    assert tips == [text for part, _, text in choice_docs() if part == "encoding"]


def test_an_open_parameter_shows_what_was_chosen_and_stays_open(form):
    form.set_choices({"encoding": "fourier"})
    form.show_chosen(choose(encoding="fourier", sigma=3.25))
    assert form.rows["sigma"].auto.text() == "auto (3.25)"
    assert "sigma" not in form.choices()
    form.rows["sigma"].auto.setChecked(False)
    assert form.choices()["sigma"] == 3.25


def test_small_and_large_numbers_can_be_typed(form, qtbot):
    form.set_choices({"encoding": "fourier", "learning_rate": 1e-4})
    editor = form.rows["learning_rate"].editor.native
    assert editor.text() == "0.0001"
    editor.lineEdit().setText("3e-5")
    editor.interpretText()
    assert form.choices()["learning_rate"] == 3e-5


def test_a_missing_device_is_locked_with_its_reason(form):
    form.show_devices({"cuda": "no driver", "mps": "no Apple computer"})
    items = {
        form.boxes["device"].itemText(row): form.boxes["device"].model().item(row)
        for row in range(form.boxes["device"].count())
    }
    assert not items["cuda"].isEnabled()
    assert items["cuda"].toolTip() == "no driver"
    assert items["cpu"].isEnabled()


def test_choices_of_another_version_are_left_out(form):
    form.set_choices({"no_such_parameter": 3})
    assert form.choices() == {}


def test_changed_preferences_win_over_what_was_left():
    usual = Preferences()
    assert remembered(usual) == {}
    remember({"motion": "affine"}, usual)
    assert remembered(usual) == {"motion": "affine"}
    assert remembered(Preferences(preset="paper", device="cpu")) == {"preset": "paper", "device": "cpu"}


def test_an_open_section_grows_with_what_is_in_it(qtbot):
    content, late = QWidget(), QLabel("there later")
    QVBoxLayout(content).addWidget(late)
    late.setFixedHeight(120)
    late.hide()
    made = section("Curves", content)
    qtbot.addWidget(made)
    made.show()
    made.expand(animate=False)
    before = made.content().maximumHeight()
    late.show()
    qtbot.waitUntil(lambda: made.content().maximumHeight() >= before + 100, timeout=2000)
    made.collapse(animate=False)
    assert made.content().maximumHeight() == 0
