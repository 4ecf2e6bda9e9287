"""How fast to forget: tissue bends, blinks and drifts out of focus, and what was seen before is then in the way.

A second scene, of the middle of the field, forgets sooner. Each frame is a sample that neither has seen yet, so which
of them it agrees with tells, without any model of noise, which of them remembers for the right time: where nothing
changes the longer memory has less noise.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.live.compiled import compiled
from napari_fiberburst.live.cores import Cores
from napari_fiberburst.live.memory import Memory
from napari_fiberburst.live.pose import Pose
from napari_fiberburst.live.reading import read

Floats = NDArray[np.float32]

# Half-lives, frames: of the second scene, the shortest, and the longest.
_SOON, SHORTEST, LONGEST = 6.0, 4.0, 20.0
# Part of the field, along each side, that the second scene has.
_MIDDLE = 0.5
# Frames over which the two are compared, and by what part the second must be better.
_FRAMES, _BETTER = 8, 0.01
# By what the half-life falls with a frame, and grows.
_FALL, _GROWTH = 0.85, 1.1
# Nodes that have been seen by less than this in either scene are not asked.
_LEAST_SEEN = 0.1
_STEPS = 4


class Forgetting:
    """Follows which half-life suits what is seen.

    Parameters
    ----------
    centres : numpy.ndarray
        (N, 2), of the cores.
    shape : (int, int)
        Height and width of a frame, pixels.
    pitch, radius : float
        Distance of neighbouring cores, and radius of their footprint, pixels.

    Attributes
    ----------
    half_life : float
        After so many frames one counts half as much.
    """

    def __init__(self, centres: NDArray[np.float64], shape: tuple[int, int], pitch: float, radius: float) -> None:
        height, width = shape
        away = np.abs(centres - [(width - 1) / 2, (height - 1) / 2]) * 2 / np.array([width, height])
        self._middle = np.flatnonzero((away < _MIDDLE).all(axis=1))
        self._cores = Cores.of(centres[self._middle], shape)
        inner = int(_MIDDLE * height), int(_MIDDLE * width)
        self._reach = complex(inner[1], inner[0]) / 2
        self._memory = Memory(inner, pitch, radius, float(inner[0] * inner[1]), 1)
        self._width = 0.5 * pitch
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget what was seen: a new scene begins."""
        self._memory.clear(1)
        self._sums = np.zeros(2)
        self._is_begun = False
        self.half_life = LONGEST

    def turn_to(self, pose: Pose) -> None:
        """Let the second scene lie upright in a frame too."""
        self._memory.turn_to(pose)

    def take(self, pose: Pose, values: Floats, weights: Floats, scene: Floats, memory: Memory) -> None:
        """Take in a frame that is not in the scene yet.

        Parameters
        ----------
        pose : Pose
            How the frame lies on the scene.
        values, weights : numpy.ndarray
            (N,), what all its cores show, at the brightness of the scene.
        scene : numpy.ndarray
            (rows, columns), the scene on the nodes of the memory.
        memory : Memory
            It knows how much each node has been seen.
        """
        values, weights = values[self._middle], weights[self._middle]
        own = self._memory
        own.centre_on(pose.place - self._reach, pose.place + self._reach)
        if self._is_begun:
            self._compare(pose, values, weights, scene, memory)
        own.forget(0.5 ** (1 / _SOON))
        own.add(self._cores, pose, values[:, None], weights)
        if not self._is_begun:
            own.start(self._width)
            self._is_begun = True
        own.solve(_STEPS)

    def _compare(self, pose: Pose, values: Floats, weights: Floats, scene: Floats, memory: Memory) -> None:
        """Let the half-life follow which scene the frame agrees with."""
        own, sums = self._memory, np.zeros(2)
        _differences(
            self._cores.x,
            self._cores.y,
            *memory.nodes.under(pose),
            scene,
            memory.seen,
            np.float32(_LEAST_SEEN * memory.growth),
            *own.nodes.under(pose),
            own.scene[0],
            own.seen,
            np.float32(_LEAST_SEEN * own.growth),
            values,
            weights,
            sums,
        )
        self._sums += (sums - self._sums) / _FRAMES
        longer, shorter = self._sums
        self.half_life *= _FALL if longer > (1 + _BETTER) * shorter else _GROWTH
        self.half_life = min(max(self.half_life, SHORTEST), LONGEST)


@compiled(
    "void(f4[::1], f4[::1], f8, f8, f8, f8, f4[:,::1], f4[:,::1], f4, f8, f8, f8, f8, f4[:,::1], f4[:,::1], f4, "
    "f4[::1], f4[::1], f8[::1])"
)
def _differences(
    x: Floats,
    y: Floats,
    u: Any,
    v: Any,
    a: Any,
    b: Any,
    scene: Floats,
    seen: Floats,
    enough: Any,
    other_u: Any,
    other_v: Any,
    other_a: Any,
    other_b: Any,
    other_scene: Floats,
    other_seen: Floats,
    other_enough: Any,
    values: Floats,
    weights: Floats,
    sums: NDArray[np.float64],
) -> None:
    """Add up the squares by which cores differ from two scenes, where both have been seen."""
    rows, columns = scene.shape
    other_rows, other_columns = other_scene.shape
    for core in range(len(x)):
        across, down = u + a * x[core] - b * y[core], v + b * x[core] + a * y[core]
        other_across = other_u + other_a * x[core] - other_b * y[core]
        other_down = other_v + other_b * x[core] + other_a * y[core]
        if not (0 <= across < columns - 1 and 0 <= down < rows - 1):
            continue
        if not (0 <= other_across < other_columns - 1 and 0 <= other_down < other_rows - 1):
            continue
        if not (seen[int(down), int(across)] > enough):
            continue
        if not (other_seen[int(other_down), int(other_across)] > other_enough):
            continue
        sums[0] += weights[core] * (values[core] - read(scene, across, down)) ** 2
        sums[1] += weights[core] * (values[core] - read(other_scene, other_across, other_down)) ** 2
