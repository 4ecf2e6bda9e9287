"""The convention, by arithmetic: 37 columns, 31 rows."""

import numpy as np

from napari_fiberburst.coordinates import in_pixels, unit_from_pixel

SHAPE = (31, 37)


def at(matrix, x, y):
    mapped = matrix @ [x, y, 1]
    return mapped[:2] / mapped[2]


def test_the_outer_edges_of_the_pixels_are_at_minus_one_and_one():
    unit = unit_from_pixel(SHAPE)
    np.testing.assert_allclose(at(unit, -0.5, -0.5), [-1, -1])
    np.testing.assert_allclose(at(unit, 36.5, 30.5), [1, 1])
    np.testing.assert_allclose(at(unit, 18, 15), [0, 0], atol=1e-15)
    np.testing.assert_allclose(at(unit, 0, 0), [1 / 37 - 1, 1 / 31 - 1])


def test_a_translation_in_unit_coordinates_is_half_sides_in_pixels():
    shift = np.array([[1, 0, 0.2], [0, 1, -0.4], [0, 0, 1]])
    expected = [[1, 0, 0.2 * 37 / 2], [0, 1, -0.4 * 31 / 2], [0, 0, 1]]
    np.testing.assert_allclose(in_pixels(shift[None], SHAPE)[0], expected, atol=1e-12)


def test_the_identity_stays_the_identity():
    np.testing.assert_allclose(in_pixels(np.eye(3), SHAPE), np.eye(3), atol=1e-15)
