"""What is read when it is wanted: arrays made of parts, and files that are opened once a process."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray


class _Closable(Protocol):
    def close(self) -> None: ...


Opened = TypeVar("Opened", bound=_Closable)


class Handle(Generic[Opened]):
    """A file that is opened when it is first needed and stays open; one thread has it at a time.

    A copy of it in another process, forked or unpickled, opens the file anew, because two processes that share an open
    file move each other's place in it.

    Parameters
    ----------
    opener : callable
        Opens it; can be pickled.
    """

    def __init__(self, opener: Callable[[], Opened]) -> None:
        self._opener = opener
        self._opened: Opened | None = None
        self._process = os.getpid()
        self._lock = threading.Lock()

    @contextmanager
    def use(self) -> Iterator[Opened]:
        """Have the file, open, to oneself."""
        if self._process != os.getpid():  # the lock may have been held when this process was forked
            self.__init__(self._opener)  # type: ignore[misc]
        with self._lock:
            if self._opened is None:
                self._opened = self._opener()
            yield self._opened

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._opener,)

    def __del__(self) -> None:
        if getattr(self, "_opened", None) is not None and self._process == os.getpid():
            self._opened.close()  # type: ignore[union-attr]


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """An array of equal parts, such as the pages of a file, each of which is read when a slice needs it.

    Attributes
    ----------
    read : callable
        Returns a part by its number; can be pickled.
    leading : tuple of int
        Lengths of the axes that the parts lie along.
    part : tuple of int
        Shape of a part.
    dtype : numpy.dtype
        Of the pixels.
    """

    read: Callable[[int], NDArray[Any]]
    leading: tuple[int, ...]
    part: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the whole array."""
        return (*self.leading, *self.part)

    def __getitem__(self, key: Any) -> NDArray[Any]:
        """Read a slice: integers and slices, one for each axis from the first on."""
        places = key if isinstance(key, tuple) else (key,)
        if places == (...,):
            places = ()
        count = len(self.leading)
        chosen = np.arange(np.prod(self.leading, dtype=int)).reshape(self.leading)[places[:count]]
        inner = (..., *places[count:]) if not places[count:] else places[count:]
        parts = [self.read(int(number))[inner] for number in np.ravel(chosen)]
        shape = parts[0].shape if parts else np.empty(self.part, bool)[inner].shape
        return np.array(parts, self.dtype).reshape(np.shape(chosen) + shape)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[...], dtype)
