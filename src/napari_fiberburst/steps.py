"""Steps of the method are generators: they yield what is known so far, and return what they have come to."""

from collections.abc import Generator
from typing import TypeVar

Snapshot = TypeVar("Snapshot")
Value = TypeVar("Value")


def drain(steps: Generator[Snapshot, None, Value]) -> Value:
    """Run steps to their end, and return what they return."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            value: Value = end.value
            return value
