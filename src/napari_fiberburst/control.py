"""A handle on a running reconstruction, safe to use from another thread."""

import threading

from napari_fiberburst.errors import SettingsError


class Control:
    """Stop, pause and resume a run, and change its sigma and learning rate while it goes.

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
        """Frequency spread of the Fourier encoding; None, as at the start, leaves the settings' value."""
        return self._sigma

    @sigma.setter
    def sigma(self, value: float) -> None:
        self._sigma = _positive("sigma", value)

    @property
    def learning_rate(self) -> float | None:
        """Step size of Adam; None, as at the start, leaves the settings' value."""
        return self._learning_rate

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        self._learning_rate = _positive("learning_rate", value)

    def wait_while_paused(self) -> None:
        """Block while paused; a stop ends the pause."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or not self._paused)


def _positive(name: str, value: float) -> float:
    if not 0 < value < float("inf"):
        raise SettingsError(f"{name} must be a number above 0; got {value!r}")
    return float(value)
