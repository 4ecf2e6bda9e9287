"""A handle on a running reconstruction, safe to use from another thread."""

import math
import threading
from collections.abc import Callable

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.settings import Fourier, NetworkMethod
from napari_fiberburst.settings.parameter import parameters_of

_PARAMETERS = {"sigma": parameters_of(Fourier)["sigma"], "learning_rate": parameters_of(NetworkMethod)["learning_rate"]}
# How often a paused run asks whether it should end.
_SECONDS_BETWEEN_LOOKS = 0.1

Region = tuple[float, float, float, float]


class Control:
    """Stop, pause and resume a run, and change its sigma, learning rate and favoured region while it goes.

    Examples
    --------
    >>> control = Control()
    >>> control.learning_rate = 1e-3
    >>> control.stop()
    >>> control.stopped
    True
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._stopped = False
        self._paused = False
        self._sigma: float | None = None
        self._learning_rate: float | None = None
        self._region: Region | None = None

    def stop(self) -> None:
        """End the run after the step it is in; it returns what it has. A stopped control stays stopped."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def pause(self) -> None:
        """Hold the run before its next step."""
        with self._changed:
            self._paused = True

    def resume(self) -> None:
        """Let a paused run go on."""
        with self._changed:
            self._paused = False
            self._changed.notify_all()

    @property
    def stopped(self) -> bool:
        """Whether the run was told to stop."""
        return self._stopped

    @property
    def paused(self) -> bool:
        """Whether the run is held."""
        return self._paused

    @property
    def sigma(self) -> float | None:
        """Frequency spread of the Fourier encoding to go on with; None leaves it as it is."""
        return self._sigma

    @sigma.setter
    def sigma(self, value: float | None) -> None:
        self._sigma = _checked("sigma", value)

    @property
    def learning_rate(self) -> float | None:
        """Step size of Adam to go on with; None leaves it as it is."""
        return self._learning_rate

    @learning_rate.setter
    def learning_rate(self, value: float | None) -> None:
        self._learning_rate = _checked("learning_rate", value)

    @property
    def region(self) -> Region | None:
        """What a network learns first, x0, y0, x1, y1 in pixels of frame 0; None favours nothing.

        For a quarter of the steps, samples of the region are drawn beside those that are drawn anyhow; then all is
        learned alike again. A spline is solved everywhere at once, within seconds, and has no use for it.
        """
        return self._region

    @region.setter
    def region(self, value: Region | None) -> None:
        if value is not None:
            is_region = isinstance(value, tuple) and len(value) == 4 and all(math.isfinite(edge) for edge in value)
            if not (is_region and value[0] < value[2] and value[1] < value[3]):
                raise SettingsError(f"region must be x0, y0, x1, y1 with x0 < x1 and y0 < y1; got {value!r}")
        self._region = value

    def wait_while_paused(self, should_stop: Callable[[], bool] | None = None) -> None:
        """Block while paused; a stop ends the pause, and so does `should_stop` where it returns True."""
        while self._paused and not self._stopped:
            if should_stop is not None and should_stop():
                return
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or not self._paused, timeout=_SECONDS_BETWEEN_LOOKS)


def _checked(name: str, value: float | None) -> float | None:
    """Return a live value by the rule that its setting has."""
    if value is not None:
        _PARAMETERS[name].check(value)
    return value
