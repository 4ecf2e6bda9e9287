"""The way of a joint registration through its levels, without what the package does between them."""

from napari_fiberburst.motion.joint import enter, iterate, normalise, start
from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.motion.problem import COARSE, FINER


def through_levels(problem, shifts, shape):
    """Return the state of a problem whose frames (height, width) start from shifts (T, 2)."""
    state = start(problem, FrameMotion.of_shifts(shifts, shape))
    for level in (COARSE, *FINER):
        state = enter(problem, state, level, None)
        for number in range(level.iterations):
            state, _ = iterate(problem, state, level, number)
        state = normalise(problem, state)
    return state
