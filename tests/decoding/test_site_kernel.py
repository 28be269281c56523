"""Tests of the site-to-pixel kernel: against point forces in closed form, summed over pixels."""

import numpy as np
import pytest

from resonator_daemon.decoding.contact_physics.pixels import PixelLattice
from resonator_daemon.decoding.contact_physics.site_kernel import site_kernel
from resonator_daemon.elastic import HalfSpace
from simulators.half_space_fields import hertz_fields

YOUNGS_PASCAL = 3e5


def closed_form(sites_m, depth_m, nu, centre_m, pitch_m):
    """Signals (3 components, 3 channels, n) under 1 Pa on one pixel."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    total = np.zeros((3, 3, len(sites_m)))
    for x, x_weight in zip(nodes, weights, strict=True):
        for y, y_weight in zip(nodes, weights, strict=True):
            offsets = sites_m - centre_m - np.array([x, y]) * pitch_m / 2
            fields = hertz_fields(offsets, depth_m, [0.0], YOUNGS_PASCAL, nu)[0]
            total += x_weight * y_weight * fields * pitch_m**2 / 4
    return total * np.array([[1.5 / YOUNGS_PASCAL], [1.0], [1.0]])


@pytest.mark.parametrize("nu", [0.3, 0.5])
def test_irregular_sites_of_two_depths_see_pixels_as_the_closed_form_says(nu):
    rng = np.random.default_rng(3)
    sites_m = rng.uniform(-2e-3, 2e-3, (30, 2))
    depths_m = np.where(np.arange(30) % 3, 1e-3, 1.3e-3)
    lattice = PixelLattice.over(sites_m, 1e-3)
    noise_std = rng.uniform(1.0, 2.0, (3, 30))
    kernel = site_kernel(HalfSpace(YOUNGS_PASCAL, nu), sites_m, depths_m, noise_std, lattice)
    kernel = (kernel * noise_std).reshape(3, -1, 3, 30)
    for pixel in (0, len(lattice.centres_m) // 2 + 3, len(lattice.centres_m) - 1):
        for depth_m in (1e-3, 1.3e-3):
            at = depths_m == depth_m
            expected = closed_form(sites_m[at], depth_m, nu, lattice.centres_m[pixel], lattice.pitch_m)
            np.testing.assert_allclose(kernel[:, pixel][..., at], expected, atol=1e-4 * np.abs(kernel).max())


@pytest.mark.parametrize("pitch_m", [5e-4, 7e-4])
def test_a_grid_of_sites_repeats_with_the_widest_pixels_or_not_at_all(pitch_m):
    axis = (np.arange(6) - 2.5) * pitch_m
    sites_m = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    lattice = PixelLattice.over(sites_m, 1e-3)
    assert (lattice.pitch_m == pytest.approx(pitch_m)) == (pitch_m == 5e-4)
    noise_std = np.repeat([[1.0], [2.0], [3.0]], 36, axis=1)
    kernel = site_kernel(HalfSpace(YOUNGS_PASCAL, 0.5), sites_m, np.full(36, 1e-3), noise_std, lattice)
    for pixel in (0, len(lattice.centres_m) // 2 + lattice.shape[1] // 2):
        expected = closed_form(sites_m, 1e-3, 0.5, lattice.centres_m[pixel], lattice.pitch_m) / noise_std
        found = kernel.reshape(3, -1, 3, 36)[:, pixel]
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(kernel).max())
