"""Whether the probe moves so far while a frame is exposed that its picture smears.

A smeared frame shows the scene averaged along its way. What the frame differs by from the scene of those before goes
with what such an average would change, by a factor that is 1 where the way is as long as the step to this frame, and
falls with the square of its length. A frame that is as sharp as the scene, or sharper, has about 0 or less. Noise of
the scene, and frames that do not quite fit it, make that factor large too, but as much so across the way.
"""

from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.live.compiled import compiled
from napari_fiberburst.live.cores import Cores
from napari_fiberburst.live.memory import Memory
from napari_fiberburst.live.pose import Pose
from napari_fiberburst.live.reading import read

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
        self, step: complex, cores: Cores, pose: Pose, values: Floats, weights: Floats, scene: Floats, memory: Memory
    ) -> None:
        """Take in a frame.

        Parameters
        ----------
        step : complex
            From the frame before, x + i y in pixels of the scene.
        cores : Cores
            Of the frame.
        pose : Pose
            How the frame lies on the scene.
        values, weights : numpy.ndarray
            (N,), what the cores show at the brightness of the scene.
        scene : numpy.ndarray
            (rows, columns), the scene without this frame, on the nodes of the memory.
        memory : Memory
            It knows how much each node has been seen.
        """
        square = 0.0
        if abs(step) > _LEAST_STEP * self._pitch:
            nodes, enough = memory.nodes, np.float32(_LEAST_SEEN * memory.growth)
            way = step / nodes.spacing
            sums = np.zeros((2, 2))
            _sum(
                cores.x,
                cores.y,
                *nodes.under(pose),
                scene,
                memory.seen,
                enough,
                values,
                weights,
                way.real,
                way.imag,
                sums,
            )
            along, across = sums[:, 1] / np.maximum(sums[:, 0], 1e-12)
            square = (along - max(across, 0.0)) * (abs(step) / self._pitch) ** 2
        self._squares = [*self._squares, square][-_FRAMES:]


@compiled("void(f4[::1], f4[::1], f8, f8, f8, f8, f4[:,::1], f4[:,::1], f4, f4[::1], f4[::1], f8, f8, f8[:,::1])")
def _sum(
    x: Floats,
    y: Floats,
    u: Any,
    v: Any,
    a: Any,
    b: Any,
    scene: Floats,
    seen: Floats,
    enough: Any,
    values: Floats,
    weights: Floats,
    way_x: Any,
    way_y: Any,
    sums: NDArray[np.float64],
) -> None:
    """Add up how a smear would change a frame, along a way in nodes and across it.

    Its power goes into the first column of `sums`, and how far the frame goes with it into the second.
    """
    rows, columns = scene.shape
    reach = 0.5 * max(abs(way_x), abs(way_y))
    for core in range(len(x)):
        across, down = u + a * x[core] - b * y[core], v + b * x[core] + a * y[core]
        if not (reach <= across < columns - 1 - reach and reach <= down < rows - 1 - reach):
            continue
        if not seen[int(down), int(across)] > enough:
            continue
        sharp = read(scene, across, down)
        left = values[core] - sharp
        for number in range(2):
            dx, dy = (way_x, way_y) if number == 0 else (-way_y, way_x)
            total = 0.0
            for moment in range(_MOMENTS):
                part = (moment + 0.5) / _MOMENTS - 0.5
                total += read(scene, across + part * dx, down + part * dy)
            change = total / _MOMENTS - sharp
            sums[number, 0] += weights[core] * change * change
            sums[number, 1] += weights[core] * change * left
