"""Control: a run held and let go from another thread."""

import threading

import pytest

from napari_fiberburst import Control
from napari_fiberburst.errors import SettingsError


def waiter(control):
    thread = threading.Thread(target=control.wait_while_paused, daemon=True)
    thread.start()
    return thread


def test_pause_holds_and_resume_lets_go():
    control = Control()
    control.pause()
    thread = waiter(control)
    thread.join(0.05)
    assert thread.is_alive()
    control.resume()
    thread.join(5)
    assert not thread.is_alive()


def test_a_pause_can_end_by_another_wish():
    control = Control()
    control.pause()
    control.wait_while_paused(should_stop=lambda: True)
    assert control.paused


def test_pause_then_resume_at_once_ends_running():
    control = Control()
    control.pause()
    control.resume()
    assert not control.paused
    control.wait_while_paused()


def test_stop_ends_a_pause():
    control = Control()
    control.pause()
    thread = waiter(control)
    control.stop()
    thread.join(5)
    assert not thread.is_alive()
    assert control.stopped


@pytest.mark.parametrize("value", [0, -1, float("nan"), float("inf"), "3"])
def test_live_values_must_be_positive(value):
    control = Control()
    for name in ("sigma", "learning_rate"):
        with pytest.raises(SettingsError, match=f"{name} must be a number above 0 and of at most"):
            setattr(control, name, value)
