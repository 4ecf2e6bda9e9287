"""What a user is told where work in the background has failed."""

import logging

from napari_fiberburst.errors import FiberBurstError

logger = logging.getLogger(__name__)


def why(error: Exception, problem: str) -> str:
    """Return the reason in words; one that was not foreseen goes into the log too, after what has failed."""
    if isinstance(error, FiberBurstError):
        return str(error)
    logger.error(problem, exc_info=error)
    return f"{type(error).__name__}: {error}"
