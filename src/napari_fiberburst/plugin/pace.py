"""How often something may be drawn, so that drawing leaves the time to the fit."""

import time

# Nobody shall wait longer than this for the next drawing, however slow they are.
_LONGEST_WAIT = 2.0


class Pace:
    """Keeps drawings of one kind to a part of the time; all times are seconds of one clock.

    What the next drawing will take is told by the faster one of the last two: a drawing that was slow by itself, as the
    first one of a layer is, costs nothing.

    Parameters
    ----------
    share : float
        The part of the time that drawing may take, where that makes nobody wait for more than two seconds.
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self._drawn = 0.0
        self._took: tuple[float, ...] = ()

    def is_due(self, now: float) -> bool:
        """Whether the next drawing may begin."""
        if not self._took:
            return True
        return now - self._drawn >= min(min(self._took) / self._share, _LONGEST_WAIT)

    def note(self, began: float, ended: float) -> None:
        """Take in how long a drawing took."""
        self._drawn = ended
        self._took = (*self._took[-1:], ended - began)

    def note_end(self, began: float) -> None:
        """Take in a drawing that ends now, on the clock of `time.perf_counter`."""
        self.note(began, time.perf_counter())
