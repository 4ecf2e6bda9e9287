"""Scores on images and motions whose score is known."""

import numpy as np
import pytest

from napari_fiberburst.quality import match_levels, motion_error, psnr, ssim


def test_gain_and_offset_per_channel_do_not_count(rng):
    truth = rng.random((31, 37, 3))
    dimmed = truth * [0.2, 0.5, 0.9] + [0.3, 0.1, 0.0]
    np.testing.assert_allclose(match_levels(dimmed, truth), truth, atol=1e-12)
    assert psnr(dimmed, truth) > 100
    assert ssim(dimmed, truth) == pytest.approx(1)


def test_psnr_of_known_noise(rng):
    truth = rng.random((200, 301))
    noisy = truth + rng.normal(0, 0.01, truth.shape)
    assert psnr(noisy, truth) == pytest.approx(40, abs=0.1)


def test_a_constant_image_scores_as_the_mean(rng):
    truth = rng.random((31, 37))
    assert psnr(np.zeros_like(truth), truth) == pytest.approx(-10 * np.log10(truth.var()))


def test_shapes_must_agree(rng):
    with pytest.raises(ValueError, match="one shape"):
        psnr(rng.random((3, 4)), rng.random((4, 3)))


def shifts(*offsets):
    matrices = np.tile(np.eye(3), (len(offsets), 1, 1))
    matrices[:, :2, 2] = offsets
    return matrices


def test_a_common_warp_of_the_scene_is_no_error(rng):
    truth = shifts((0, 0), (5, -3), (-8, 2))
    gauge = np.array([[1.05, 0.1, 4], [-0.08, 0.97, -2], [1e-4, -2e-4, 1]])
    assert motion_error(gauge @ truth, truth, (31, 37)) < 1e-6


def test_a_known_error_is_found():
    truth = shifts((0, 0), (5, -3), (-8, 2), (1, 1))
    wrong = truth.copy()
    wrong[:, 0, 2] += [0.5, -0.5, 0.5, -0.5]  # no common warp can undo it
    assert motion_error(wrong, truth, (101, 201)) == pytest.approx(0.5, rel=0.05)
