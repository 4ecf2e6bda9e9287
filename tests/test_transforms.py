"""Homographies against scikit-image's, and their gradients against finite differences."""

import numpy as np
import torch
from skimage.transform import ProjectiveTransform

from napari_fiberburst.coordinates import relative_to, transform_points


def near_identity(rng, count):
    return np.eye(3) + 0.1 * rng.standard_normal((count, 3, 3))


def test_points_are_mapped_by_the_projective_transform_of_scikit_image(rng):
    matrices, points = near_identity(rng, 4), rng.uniform(-1, 1, (4, 7, 2))
    mapped = transform_points(torch.from_numpy(matrices), torch.from_numpy(points)).numpy()
    np.testing.assert_allclose(transform_points(matrices, points), mapped, atol=1e-12)
    for matrix, given, found in zip(matrices, points, mapped, strict=True):
        np.testing.assert_allclose(found, ProjectiveTransform(matrix)(given), atol=1e-12)


def test_a_translation_moves_x_by_its_x():
    shift = torch.tensor([[1.0, 0, 0.25], [0, 1, -0.5], [0, 0, 1]])
    np.testing.assert_allclose(transform_points(shift, torch.tensor([[0.5, 0.5]])), [[0.75, 0.0]])


def test_gradients_agree_with_finite_differences(rng):
    matrices = torch.from_numpy(near_identity(rng, 3)).requires_grad_()
    points = torch.from_numpy(rng.uniform(-1, 1, (3, 5, 2))).requires_grad_()
    assert torch.autograd.gradcheck(transform_points, (matrices, points), eps=1e-6, atol=1e-7)


def test_a_frame_0_seen_edge_on_leaves_nothing_to_say():
    matrices = np.stack([np.diag([1.0, 0, 1]), np.eye(3)])
    found = relative_to(matrices, 0)
    np.testing.assert_array_equal(found[0], np.eye(3))
    assert np.isnan(found[1]).all()


def test_what_is_relative_has_no_gauge(rng):
    truth, gauge = near_identity(rng, 5), near_identity(rng, 1)[0]
    truth[0] = np.eye(3)
    found = relative_to(gauge @ truth, 0)
    np.testing.assert_allclose(found, truth / truth[:, 2:, 2:], atol=1e-12)
    np.testing.assert_array_equal(found[0], np.eye(3))
    other = relative_to(gauge @ truth, 2)
    np.testing.assert_array_equal(other[2], np.eye(3))
    np.testing.assert_allclose(relative_to(other, 0), found, atol=1e-9)
