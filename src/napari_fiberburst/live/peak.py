"""Peaks between samples."""


def beyond(before: float, at: float, after: float) -> float:
    """Return how far beyond a highest value, -0.5 to 0.5, a parabola through it and its neighbours has its peak."""
    bend = before - 2 * at + after
    return min(max((before - after) / (2 * bend), -0.5), 0.5) if bend < 0 else 0.0
