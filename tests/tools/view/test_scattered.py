"""Scattered sites as pixels: the nearest site's value inside the outline, nothing outside, row 0 at the least y."""

import math

import numpy as np

from resonator_daemon.tools.view.maps import as_pixels

OUTLINE_M = ((-4e-3, -8e-3), (4e-3, -8e-3), (4e-3, 3.9e-3), (0.0, 8e-3), (-4e-3, 3.9e-3))  # a house
SITES_M = ((-2.03e-3, -6.01e-3), (3.04e-3, -5.1e-3), (0.5e-3, 5e-3))


def test_each_pixel_is_that_of_the_nearest_site_by_brute_force() -> None:
    values = np.array([1.0, 2.0, math.nan])
    pixels = as_pixels(values, OUTLINE_M, SITES_M)
    assert pixels.shape == (32, 16)
    for row in range(32):
        for column in range(16):
            place = (-3.75e-3 + 0.5e-3 * column, -7.75e-3 + 0.5e-3 * row)
            under_the_roof = 1.025 * abs(place[0]) + max(place[1] - 3.9e-3, 0.0) < 4.1e-3
            nearest = min(range(3), key=lambda site: math.dist(place, SITES_M[site]))
            expected = values[nearest] if under_the_roof else -math.inf
            assert np.array_equal(pixels[row, column], expected, equal_nan=True), place
    assert set(pixels[np.isfinite(pixels)]) == {1.0, 2.0}
    assert np.isnan(pixels).any()


def test_an_outline_that_pixels_do_not_fill_evenly_is_covered() -> None:
    triangle = ((0.0, 0.0), (10e-3, 0.0), (0.0, 3.1e-3))
    pixels = as_pixels(np.array([5.0]), triangle, ((1e-3, 1e-3),))
    assert pixels.shape == (10, 32)
    assert np.isfinite(pixels).mean() == 0.5
