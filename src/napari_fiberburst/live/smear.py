"""Whether the probe moves so far while a frame is exposed that its picture smears.

A smeared frame shows the scene averaged along its way. What the frame differs by from the scene of those before goes
with what such an average would change, by a factor that is 1 where the way is as long as the step to this frame, and
falls with the square of its length. A frame that is as sharp as the scene, or sharper, has about 0 or less. Noise of
the scene, and frames that do not quite fit it, make that factor large too, but as much so across the way.
"""

from statistics import median

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.live.nodes import Nodes

Floats = NDArray[np.float32]

# Points to a way.
_MOMENTS = 5
# Steps that are shorter than so many pitches do not smear.
_LEAST_STEP = 0.4
# Smears that look longer than so many pitches are told, by the median of so many frames: those of 0.8 pitches and more
# always do, those of 0.3 never. Single frames may look like anything.
_LEAST_LENGTH, _FRAMES = 0.33, 3
# Nodes that have been seen by less than this are not asked.
_LEAST_SEEN = 0.1


class Smear:
    """Follows how long smears are, beside the scene as it stands.

    Parameters
    ----------
    pitch : float
        Distance of neighbouring cores, pixels.
    """

    def __init__(self, pitch: float) -> None:
        self._pitch = pitch
        self._squares: list[float] = []

    @property
    def is_told(self) -> bool:
        """Whether the last frames were smeared."""
        return len(self._squares) == _FRAMES and median(self._squares) > _LEAST_LENGTH**2

    def take(
        self,
        step: complex,
        points: NDArray[np.complex128],
        values: Floats,
        weights: Floats,
        nodes: Nodes,
        scene: Floats,
        seen: Floats,
    ) -> None:
        """Take in a frame.

        Parameters
        ----------
        step : complex
            From the frame before, x + i y in pixels of the scene.
        points, values, weights : numpy.ndarray
            (N,), where its cores look, and what they show at the brightness of the scene.
        nodes, scene, seen
            Of the scene without this frame, (rows, columns).
        """
        square = 0.0
        if abs(step) > _LEAST_STEP * self._pitch:
            square = _score(step, points, values, weights, nodes, scene, seen) * (abs(step) / self._pitch) ** 2
        self._squares = [*self._squares, square][-_FRAMES:]


def _score(
    step: complex,
    points: NDArray[np.complex128],
    values: Floats,
    weights: Floats,
    nodes: Nodes,
    scene: Floats,
    seen: Floats,
) -> float:
    """Return by what factor a frame differs from the scene as a smear along its whole step would."""
    here = nodes.corners(points)
    sharp = here.read(scene)
    weights = weights * here.inside * (here.read(seen) > _LEAST_SEEN)
    left = values - sharp
    moments = (np.arange(_MOMENTS) + 0.5) / _MOMENTS - 0.5

    def factor(way: complex) -> float:
        change = np.mean([nodes.corners(points + part * way).read(scene) for part in moments], axis=0) - sharp
        power = float((weights * change**2).sum())
        return float((weights * change * left).sum()) / power if power > 0 else 0.0

    return factor(step) - max(factor(1j * step), 0.0)
