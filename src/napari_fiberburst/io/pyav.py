"""PyAV, which reads and writes video files, where it is installed."""

from typing import Any

from napari_fiberburst.errors import BurstError, FiberBurstError


def import_av(doing: str, error: type[FiberBurstError] = BurstError) -> Any:
    """Return PyAV.

    Parameters
    ----------
    doing : str
        What needs it, such as "reading clip.avi".
    error : type of FiberBurstError
        What is raised where it is not installed.

    Raises
    ------
    BurstError
        Or `error`: it is not installed.
    """
    try:
        import av
    except ImportError as missing:
        raise error(
            f"{doing} needs the package av; install it by: pip install 'napari-fiberburst[recordings]'"
        ) from missing
    return av
