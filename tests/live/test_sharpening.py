"""Pictures of scenes that are known."""

import numpy as np
import pytest

from napari_fiberburst.live.cores import Cores
from napari_fiberburst.live.memory import Memory
from napari_fiberburst.live.pose import Pose
from napari_fiberburst.live.sharpening import Sharpener

SHAPE = (61, 77)


def picture(pitch, pose, scene):
    """Return what is drawn of a scene, a function of (x, y), that was seen at all pixels without any footprint."""
    radius = 0.36 * pitch
    memory = Memory(SHAPE, pitch, radius, float(np.prod(SHAPE)), channels=1)
    y, x = np.indices(SHAPE).reshape(2, -1)
    cores = Cores.of(np.stack([x, y], axis=1).astype(np.float64), SHAPE)
    points = pose.points(x + 1j * y)
    values = scene(points.real, points.imag).astype(np.float32)[:, None]
    for _ in range(8):
        memory.add(cores, pose, values, np.ones(x.size, np.float32))
    memory.start(pitch)
    memory.solve(100)
    ground = np.full(SHAPE, 10, np.float32)
    return memory.nodes.spacing, Sharpener(memory, radius)(memory, pose, 200.0, ground)[..., 0]


@pytest.mark.parametrize(("pitch", "spacing"), [(3.3, 1.0), (4.9, 1.5), (6.7, 2.0)])
@pytest.mark.parametrize("turn", [1 + 0j, 1.019 + 0.031j])
def test_slow_waves_are_drawn_as_they_are_at_every_spacing(pitch, spacing, turn):
    def scene(x, y):
        return 0.5 + 0.3 * np.sin(2 * np.pi * (x + 0.5 * y) / 40)

    pose = Pose.at_rest(SHAPE).moved(0.3 + 0.4j, turn)
    used, image = picture(pitch, pose, scene)
    assert used == spacing
    points = pose.points(np.arange(SHAPE[1]) + 1j * np.arange(SHAPE[0])[:, None])
    rim = slice(10, -10)
    wanted = 10 + 200 * scene(points.real, points.imag)
    # The footprint is undone where none was: waves of 36 pixels gain some per cent.
    np.testing.assert_allclose(image[rim, rim], wanted[rim, rim], atol=6)
