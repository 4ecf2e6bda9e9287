"""A mailbox between a fast thread and a slow one: only the newest item waits. Knows nothing of Qt."""

import threading
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Latest(Generic[Item]):
    """Holds the newest item put into it until it is taken.

    A queue between a fit and a window would grow by an image with every report the window is too slow for.

    Examples
    --------
    >>> box = Latest[int]()
    >>> box.put(1)
    >>> box.put(2)
    >>> box.take(), box.take()
    (2, None)
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._item: Item | None = None

    def put(self, item: Item) -> None:
        """Leave an item; one that waits is dropped."""
        with self._lock:
            self._item = item

    def take(self) -> Item | None:
        """Return the newest item and forget it; None where there is nothing new."""
        with self._lock:
            item, self._item = self._item, None
        return item
