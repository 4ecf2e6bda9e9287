"""How far work on a long recording is, as a bar."""

from collections.abc import Generator
from typing import Any, TypeVar

from tqdm import tqdm

Result = TypeVar("Result")


def followed(steps: Generator[Any, None, Result]) -> Result:
    """Do work that yields what it does and how much of that is done, and return what has come of it."""
    with tqdm(total=1.0, bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}") as bar:
        while True:
            try:
                doing = next(steps)
            except StopIteration as end:
                result: Result = end.value
                return result
            bar.set_description(doing.what)
            bar.n = doing.part
            bar.refresh()
