"""Work beside the frames: one job at a time, in a thread of its own, so that pictures go on meanwhile."""

import threading
import weakref
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, TypeVar

import torch

from napari_fiberburst.steps import drain

Value = TypeVar("Value")
Job = Generator[Any, None, Value]


class Background(Generic[Value]):
    """Does one job at a time. A job is a generator that returns its result; between its steps it can be stopped.

    Torch uses one thread in it: more would hold up the pictures, and wait for one another where processors are busy,
    so that frames this small took two of them three times the processors' time of one.

    Parameters
    ----------
    waits : bool
        Whether `begin` returns when the job is done, so that what comes of frames does not depend on how long jobs
        take.
    """

    def __init__(self, *, waits: bool) -> None:
        self._waits = waits
        self._pool: ThreadPoolExecutor | None = None
        self._job: Future[Value | None] | None = None
        self._stop = threading.Event()
        # A job does not outlive by more than a step whoever has asked for it.
        weakref.finalize(self, self._stop.set)

    @property
    def is_busy(self) -> bool:
        """Whether there is a job whose result has not been taken."""
        return self._job is not None

    def begin(self, job: Job[Value]) -> None:
        """Begin a job; the one before has been taken."""
        if self._waits:
            self._job = Future()
            self._job.set_result(drain(job))
            return
        if self._pool is None:
            self._pool = _pool_of_one()
        self._job = self._pool.submit(_done, job, self._stop)

    def taken(self) -> Value | None:
        """Take the result of the job, once it is done; None before, and where there is no job.

        Raises
        ------
        Exception
            As the job.
        """
        if self._job is None or not self._job.done():
            return None
        job, self._job = self._job, None
        return job.result()

    def close(self) -> None:
        """Stop, and return when nothing runs any more: after a step of the job at most."""
        self._stop.set()
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        self._pool = self._job = None


def _done(job: Job[Value], stop: threading.Event) -> Value | None:
    """Return what a job returns, or None where it was stopped."""
    while not stop.is_set():
        try:
            next(job)
        except StopIteration as end:
            value: Value = end.value
            return value
    return None


def _pool_of_one() -> ThreadPoolExecutor:
    """Return a thread in which torch uses no others, and as many as before elsewhere."""
    threads = torch.get_num_threads()
    pool = ThreadPoolExecutor(1, "beside live view", initializer=torch.set_num_threads, initargs=(1,))
    pool.submit(int).result()
    torch.set_num_threads(threads)  # torch takes the last number that was set for all threads to come, too
    return pool
