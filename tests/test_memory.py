"""The estimate grows with what a run holds."""

import pytest

from napari_fiberburst.memory import estimate_memory
from napari_fiberburst.settings import choose

SHAPE = (20, 256, 256, 3)


@pytest.mark.parametrize(
    "more",
    [{"upsample": 2.0}, {"canvas": "union"}, {"encoding": "fourier"}, {"encoding": "fourier", "batch": 100_000}],
)
def test_more_to_hold_takes_more(more):
    assert estimate_memory(SHAPE, choose(**more)) > estimate_memory(SHAPE, choose())


def test_twice_the_frames_take_more_but_not_twice():
    usual, twice = (estimate_memory((frames, *SHAPE[1:]), choose()) for frames in (20, 40))
    assert usual < twice < 2 * usual


def test_a_published_run_is_told_by_its_batch():
    small, large = (estimate_memory(SHAPE, choose("paper", batch=batch)) for batch in (1000, 100_000))
    assert large - small > 99_000 * 4 * 256
