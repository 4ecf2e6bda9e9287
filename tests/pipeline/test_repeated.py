"""Frames that repeat another one count once."""

import numpy as np
import pytest

from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.pipeline.repeated import find_repeated
from napari_fiberburst.quality import match_levels, psnr
from napari_fiberburst.simulation import Camera, simulate


@pytest.fixture(scope="module")
def noisy():
    """Return a burst in which noise, taken for detail, would be seen."""
    look = {"shape": (121, 137), "frames": 10, "channels": 1, "physics": "core", "pitch": 5.0, "seed": 2}
    return simulate("histology", camera=Camera(photons=200, read_noise=0.01), **look)


@pytest.fixture(scope="module")
def once(noisy):
    return reconstruct(noisy.burst)


def quality(result, simulated):
    image = np.nan_to_num(result.image).reshape(simulated.truth[0].shape)
    return psnr(match_levels(image, simulated.truth[0]), simulated.truth[0])


@pytest.mark.parametrize("order", [[0, 1, 1, 2, 3, 4, 4, 5, 5, 6, 7, 8, 9], [*range(9), *range(9), 9]])
def test_copies_change_nothing(noisy, once, order):
    result = reconstruct(noisy.burst.frames[order])
    assert quality(result, noisy) == pytest.approx(quality(once, noisy), abs=0.1)
    assert result.resolution == pytest.approx(once.resolution, abs=0.1)
    first = {frame: number for number, frame in reversed(list(enumerate(order)))}
    assert result.frames_used == tuple(sorted(first.values()))
    assert any("copies" in note for note in result.notes)
    for number, frame in enumerate(order):
        np.testing.assert_allclose(result.homographies[number], result.homographies[first[frame]], atol=1e-12)
    np.testing.assert_allclose(result.frame(len(order) - 1), result.frame(first[order[-1]]), atol=0.01)


def test_a_codec_may_have_changed_a_copy_of_8_bits_by_a_little(rng):
    frames = rng.integers(0, 256, (6, 31, 37)).astype(np.uint8)
    frames = frames[[0, 1, 1, 2, 3, 4]]
    frames[2, :4] ^= 1
    assert find_repeated(Burst(frames)).tolist() == [[2, 1]]
    assert not len(find_repeated(Burst(frames.astype(np.uint16))))


def test_an_object_that_never_moves_is_no_copy():
    still = np.repeat(np.random.default_rng(0).integers(0, 256, (1, 31, 37)), 5, axis=0).astype(np.uint8)
    assert not len(find_repeated(Burst(still)))


def test_a_copy_of_a_copy_lies_where_the_first_lies(rng):
    frames = rng.integers(0, 65536, (4, 31, 37)).astype(np.uint16)[[0, 1, 1, 1, 2, 0, 3]]
    assert find_repeated(Burst(frames)).tolist() == [[2, 1], [3, 1], [5, 0]]
