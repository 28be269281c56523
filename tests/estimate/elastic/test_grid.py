"""Transfer matrices on a grid: layout, and real fields that stay real."""

import numpy as np
import pytest
from scipy import fft

from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.elastic.half_space import HalfSpace

E = 2.0e5


@pytest.mark.parametrize("shape", [(8, 8), (8, 10), (7, 8), (8, 7), (9, 9), (1, 4)])
@pytest.mark.parametrize("output", ["sensor", "strain", "displacement"])
def test_operator_on_the_grid_is_real(shape: tuple[int, int], output: str):
    """What the half-plane does to a field is what the full plane does to it, with no imaginary remainder."""
    grid = SpectralGrid(shape, 4e-4)
    body = HalfSpace(E, 0.3)
    ny, nx = shape
    half = grid.transfer_matrix(body, output, "traction", 5e-4, zero="periodic")
    full = np.empty((ny, nx, *half.shape[2:]), complex)
    full[:, : nx // 2 + 1] = half
    for row in range(ny):
        for column in range(nx // 2 + 1, nx):
            full[row, column] = half[-row % ny, nx - column].conj()
    for row in range(ny):  # T(-omega) = conj T(omega), indices modulo the grid
        for column in range(nx):
            np.testing.assert_array_equal(full[-row % ny, -column % nx], full[row, column].conj())

    load = np.random.default_rng(3).standard_normal((3, ny, nx))
    spectrum = np.einsum("yxij,jyx->iyx", full, fft.fft2(load))
    field = fft.ifft2(spectrum)
    assert np.abs(field.imag).max() <= 1e-15 * np.abs(field).max()
    by_half = fft.irfft2(np.einsum("yxij,jyx->iyx", half, fft.rfft2(load)), s=shape)
    np.testing.assert_allclose(by_half, field.real, atol=1e-14 * np.abs(field).max())


def test_nyquist_bins_hold_no_odd_entries_and_the_others_are_untouched():
    grid = SpectralGrid((6, 8), 4e-4)
    body = HalfSpace(E, 0.3)
    matrix = grid.transfer_matrix(body, "sensor", "traction", 5e-4)
    plain = body.transfer_matrix("sensor", "traction", grid.omega_x, grid.omega_y, 5e-4)
    inside = np.ix_([0, 1, 2, 4, 5], [0, 1, 2, 3])
    np.testing.assert_array_equal(matrix[inside], plain[inside])
    np.testing.assert_array_equal(matrix[:, 4, 0, 0], 0.0)  # p_n of f_x is odd in omega_x
    np.testing.assert_array_equal(matrix[3, :, 0, 1], 0.0)  # p_n of f_y is odd in omega_y
    np.testing.assert_array_equal(matrix[:, 4, 0, 2], plain[:, 4, 0, 2])  # p_n of f_z is even
    np.testing.assert_array_equal(matrix[3, :, 1, 1], 0.0)  # eps_xz of f_y is odd in both


def test_layout_is_that_of_rfft2():
    grid = SpectralGrid((6, 8), 4e-4)
    x, y = np.arange(8) * 4e-4, np.arange(6)[:, None] * 4e-4
    for row, column in [(1, 0), (0, 2), (5, 3), (2, 1)]:
        wave = np.cos(grid.omega_x[column] * x + grid.omega_y[row, 0] * y)
        peak = np.unravel_index(np.abs(fft.rfft2(wave)).argmax(), (6, 5))
        assert peak in ((row, column), (-row % 6, column))
    assert grid.multiplicity.sum() * 6 == 48
    assert SpectralGrid((6, 7), 4e-4).multiplicity.sum() * 6 == 42


def test_refuses_an_oblong_grid_for_the_displacement_of_an_isolated_load():
    with pytest.raises(ValueError, match="must be square"):
        SpectralGrid((4, 6), 4e-4).transfer_matrix(HalfSpace(E, 0.5), "displacement", "traction", 0.0)
