"""Work on a long recording, to be done in another thread: paused, stopped and gone on with. Knows nothing of Qt."""

import logging
import time
from collections import deque
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_fiberburst.control import Control
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.plugin.drivers import without_clash
from napari_fiberburst.streaming import Latest

if TYPE_CHECKING:
    from napari_fiberburst.recordings.work import Doing

logger = logging.getLogger(__name__)


class LongJob:
    """Work in the making: how it is steered, and what it has said so far.

    Parameters
    ----------
    begin : callable
        Returns the work, which yields how far it is; may take long itself.

    Attributes
    ----------
    control : Control
        To stop and pause it.
    doing : Latest
        The newest `Doing`, for whoever looks.
    grown : deque of Path
        Images that show more than before, for whoever looks.
    result : object
        What the work has returned; None where it was stopped, or failed.
    problem : str
        Why it has failed, in words for the user.
    seconds : float
        How long it has worked.
    """

    def __init__(self, begin: "Callable[[], Generator[Doing, None, Any]]") -> None:
        self._begin = begin
        self.control = Control()
        self.doing: Latest[Doing] = Latest()
        self.grown: deque[Path] = deque()
        self.result: Any = None
        self.problem = ""
        self.seconds = 0.0

    def run(self) -> None:
        """Do the work. Raises nothing, because a worker's errors reach the window by more than one way."""
        began = time.monotonic()
        try:
            with without_clash():
                self._work()
        except FiberBurstError as error:
            self.problem = str(error)
        except Exception as error:  # whatever it is, the window must hear of it and be ready again
            logger.exception("work on a recording has failed")
            self.problem = f"{type(error).__name__}: {error}"
        self.seconds = time.monotonic() - began

    def _work(self) -> None:
        steps = self._begin()
        try:
            while not self.control.stopped:
                doing = next(steps)
                if doing.grown is not None:
                    self.grown.append(doing.grown)
                self.doing.put(doing)
                self.control.wait_while_paused()
        except StopIteration as end:
            self.result = end.value
        finally:
            steps.close()


def in_words(doing: "Doing") -> str:
    """Return what is being done, for the dock."""
    words = doing.what
    if doing.steps > 1:
        words += f", round {doing.step + 1}"
    if doing.units > 1:
        words += f", {doing.units - doing.left:,} of {doing.units:,}"
    return words
