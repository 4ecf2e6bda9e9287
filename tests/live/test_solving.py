"""The normal equations of a live scene beside dense matrices."""

import numpy as np
import pytest

from napari_fiberburst.live.cores import Cores
from napari_fiberburst.live.memory import TIE, Memory
from napari_fiberburst.live.pose import Pose
from napari_fiberburst.live.solving import multiply, solve

# Inner nodes, and where each band's neighbour lies.
ROWS, COLUMNS = 9, 14
NEIGHBOURS = [(0, 0), (0, 1), (1, 0), (1, 1), (1, -1)]
SHAPE = (23, 31)


def bands():
    """Return random couplings of inner nodes and a right-hand side, (6, rows + 2, columns + 2)."""
    rng = np.random.default_rng(4)
    planes = np.zeros((6, ROWS + 2, COLUMNS + 2), np.float32)
    for band, (down, right) in enumerate(NEIGHBOURS):
        part = planes[band, 1 : ROWS + 1 - down, 1 + (right < 0) : COLUMNS + 1 - (right > 0)]
        part[:] = rng.uniform(0, 0.2, part.shape) + 2 * (band == 0)
    planes[5, 1:-1, 1:-1] = rng.normal(size=(ROWS, COLUMNS))
    return planes


def dense(planes, tie):
    """Return the matrix over the inner nodes, with the membrane between neighbours."""
    rows, columns = planes.shape[1] - 2, planes.shape[2] - 2
    matrix = np.zeros((rows * columns, rows * columns))
    number = np.arange(rows * columns).reshape(rows, columns)
    for i in range(rows):
        for j in range(columns):
            for band, (down, right) in enumerate(NEIGHBOURS):
                if i + down < rows and 0 <= j + right < columns:
                    here, there = number[i, j], number[i + down, j + right]
                    matrix[here, there] += planes[band, i + 1, j + 1]
                    matrix[there, here] += planes[band, i + 1, j + 1] * (here != there)
                    if band in (1, 2):
                        matrix[[here, there], [here, there]] += tie
                        matrix[[here, there], [there, here]] -= tie
    return matrix


def inner(image):
    return image[..., 1:-1, 1:-1].reshape(*image.shape[:-2], -1)


def test_the_fused_product_is_that_of_the_matrix():
    planes, tie = bands(), np.float32(0.3)
    x = np.random.default_rng(5).normal(size=planes.shape[1:]).astype(np.float32)
    product = np.zeros_like(x)
    multiply(planes, tie, x, product)
    np.testing.assert_allclose(inner(product), dense(planes, tie) @ inner(x), atol=1e-5)


def test_steps_lead_to_the_solution():
    planes, tie = bands(), np.float32(0.3)
    images = np.zeros((1, *planes.shape[1:]), np.float32)
    solve(planes, tie, images, np.empty((3, *planes.shape[1:]), np.float32), 60)
    np.testing.assert_allclose(inner(images[0]), np.linalg.solve(dense(planes, tie), inner(planes[5])), atol=1e-5)


def memory_of(pitch=3.3):
    return Memory(SHAPE, pitch, 0.36 * pitch, float(np.prod(SHAPE)), channels=1)


def test_samples_are_added_as_bilinear_interpolation_has_them():
    rng = np.random.default_rng(6)
    memory = memory_of(5.0)
    assert memory.nodes.spacing == 1.5
    centres, values, weights = rng.uniform(0, 22, (40, 2)), rng.uniform(0, 1, 40), rng.uniform(0, 2, 40)
    pose = Pose.at_rest(SHAPE).moved(0.37 - 0.61j, 0.99 + 0.02j)
    memory.add(Cores.of(centres, SHAPE), pose, values[:, None].astype(np.float32), weights.astype(np.float32))
    memory.scene[:] = 0
    memory.solve(200)
    nodes = memory.nodes
    sampled = np.zeros((40, nodes.rows, nodes.columns))
    at = (pose.points(centres[:, 0] + 1j * centres[:, 1]) - nodes.origin) / nodes.spacing
    for row, point in zip(sampled, at, strict=True):
        down, right = np.abs(np.arange(nodes.rows) - point.imag), np.abs(np.arange(nodes.columns) - point.real)
        row += np.maximum(0, 1 - down)[:, None] * np.maximum(0, 1 - right)
    sampled = inner(sampled)
    tied = dense(np.zeros((5, nodes.rows, nodes.columns)), TIE)
    wanted = np.linalg.solve(sampled.T * weights @ sampled + tied, sampled.T @ (weights * values))
    np.testing.assert_allclose(inner(memory.scene[0]), wanted, atol=2e-4)
    assert memory.density == pytest.approx(weights.sum() / np.prod(SHAPE), rel=1e-5)


def test_an_even_scene_stays_even_while_the_nodes_move():
    memory = memory_of()
    y, x = np.indices(SHAPE).reshape(2, -1)
    cores = Cores.of(np.stack([x, y], axis=1) + 0.25, SHAPE)
    values, weights = np.full((x.size, 1), 0.7, np.float32), np.ones(x.size, np.float32)
    pose, first = Pose.at_rest(SHAPE), memory.nodes
    for _ in range(6):
        corner = pose.place - pose.middle
        memory.centre_on(corner, corner + complex(SHAPE[1] - 1, SHAPE[0] - 1))
        memory.forget(0.9)
        memory.add(cores, pose, values, weights)
        pose = pose.moved(-7.3 + 5.9j)
    assert memory.nodes.column < first.column - 20
    assert memory.nodes.row > first.row + 15
    memory.scene[:] = 0
    memory.solve(300)
    np.testing.assert_allclose(memory.scene, 0.7, atol=1e-3)


def test_to_bring_weights_back_to_scale_changes_nothing():
    centres = np.random.default_rng(7).uniform(0, 22, (60, 2))
    cores, pose = Cores.of(centres, SHAPE), Pose.at_rest(SHAPE)
    values, weights = np.linspace(0, 1, 60, dtype=np.float32)[:, None], np.ones(60, np.float32)
    scenes = []
    for parts in ([1e-5], [1e-1] * 5):  # the first passes the limit at once
        memory = memory_of()
        memory.add(cores, pose, values, weights)
        for part in parts:
            memory.forget(part)
        memory.add(cores, pose, 1 - values, weights)
        memory.scene[:] = 0
        memory.solve(200)
        scenes.append(memory.scene)
        assert memory.density == pytest.approx(60 / np.prod(SHAPE), rel=1e-3)
    np.testing.assert_allclose(*scenes, atol=1e-3)
