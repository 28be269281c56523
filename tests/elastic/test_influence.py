"""Surface influence coefficients against point loads integrated by quadrature, Love's value, and the matrix (18)."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import dblquad

from resonator_daemon.elastic import HalfSpace
from resonator_daemon.elastic.influence import RoughStiffness, SurfaceCompliance

E = 2.0e5
PITCH = 4e-4


def surface_of_point_load(nu: float, row: int, column: int, x: float, y: float) -> float:
    """Boussinesq and Cerruti at the surface (Johnson, Contact Mechanics, sections 3.2 and 3.6), times 4 pi mu."""
    r = np.hypot(x, y)
    along = (x, y)
    if row == column == 2:
        return 2 * (1 - nu) / r
    if row == 2:
        return (1 - 2 * nu) * along[column] / r**2
    if column == 2:
        return -(1 - 2 * nu) * along[row] / r**2
    return 2 * (1 - nu) * (row == column) / r + 2 * nu * along[row] * along[column] / r**3


@pytest.mark.parametrize("nu", [-0.5, 0.0, 0.3, 0.5])
def test_loaded_square_agrees_with_quadrature_over_point_loads(nu: float):
    body = HalfSpace(E, nu)
    compliance = SurfaceCompliance(body, (6, 5), PITCH)
    loaded_y, loaded_x = 2, 1
    for column, (y, x) in itertools.product(range(3), [(2, 2), (5, 4), (0, 0), (3, 0), (1, 1)]):
        load = np.zeros((3, 6, 5))
        load[column, loaded_y, loaded_x] = 1.0
        found = compliance.displacement_m(load)[:, y, x]
        for row in range(3):
            dx, dy = x - loaded_x, y - loaded_y
            expected, _ = dblquad(
                lambda b, a, row=row, column=column, dx=dx, dy=dy: surface_of_point_load(
                    nu, row, column, dx - a, dy - b
                ),
                *(-0.5, 0.5, -0.5, 0.5),
                epsabs=1e-11,
            )
            scale = PITCH / (4 * np.pi * body.shear_modulus_pascal)
            assert found[row] == pytest.approx(expected * scale, abs=1e-10 * scale), (row, column, y, x)


def test_middle_of_a_loaded_square_sinks_as_love_found():
    """u_z = 8 (1 - nu^2) ln(1 + sqrt 2) p b / (pi E) in the middle of a square of side 2 b, whole or in pixels."""
    for count, nu in itertools.product((1, 5), (0.0, 0.3, 0.5)):
        compliance = SurfaceCompliance(HalfSpace(E, nu), (count, count), PITCH)
        load = np.zeros((3, count, count))
        load[2] = 70.0
        found = compliance.displacement_m(load)[:, count // 2, count // 2]
        expected = 8 * (1 - nu**2) * np.log(1 + np.sqrt(2)) * 70.0 * (count * PITCH / 2) / (np.pi * E)
        np.testing.assert_allclose(found, [0.0, 0.0, expected], rtol=1e-12, atol=1e-15 * expected)
    assert SurfaceCompliance(HalfSpace(E, 0.3), (4, 4), PITCH).of_own_load == pytest.approx(
        8 * (1 - 0.3**2) * np.log(1 + np.sqrt(2)) * (PITCH / 2) / (np.pi * E), rel=1e-12
    )


@pytest.mark.parametrize("periodic", [False, True])
def test_work_is_reciprocal_and_positive(periodic: bool):
    rng = np.random.default_rng(1)
    compliance = SurfaceCompliance(HalfSpace(E, 0.2), (7, 8), PITCH, periodic=periodic)
    a, b = rng.normal(size=(2, 3, 7, 8))
    one, other = np.vdot(a, compliance.displacement_m(b)), np.vdot(b, compliance.displacement_m(a))
    assert one == pytest.approx(other, rel=1e-11)
    assert np.vdot(a, compliance.displacement_m(a)) > 0


def test_periodic_is_the_matrix_18():
    """A plane wave of traction, below the Nyquist frequency, answered by the matrix at its frequency."""
    body, shape = HalfSpace(E, 0.3), (12, 10)
    wx, wy = 2 * np.pi * 3 / (shape[1] * PITCH), -2 * np.pi * 2 / (shape[0] * PITCH)
    y, x = np.meshgrid(np.arange(shape[0]) * PITCH, np.arange(shape[1]) * PITCH, indexing="ij")
    wave = np.exp(1j * (wx * x + wy * y))
    amplitude = np.array([1.0, -0.5j, 2.0])
    found = SurfaceCompliance(body, shape, PITCH, periodic=True).displacement_m((amplitude[:, None, None] * wave).real)
    answer = body.transfer_matrix("displacement", "traction", wx, wy, 0.0) @ amplitude
    np.testing.assert_allclose(found, (answer[:, None, None] * wave).real, atol=1e-12 * np.abs(answer).max())


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("window", [(5, 6), (14, 13), (16, 15)])
def test_a_window_has_the_coefficients_of_the_whole(window: tuple[int, int], periodic: bool):
    rng = np.random.default_rng(2)
    compliance = SurfaceCompliance(HalfSpace(E, 0.3), (16, 15), PITCH, periodic=periodic)
    ny, nx = window
    load = np.zeros((3, 16, 15))
    load[:, 16 - ny :, 15 - nx :] = rng.normal(size=(3, ny, nx))
    whole = compliance.displacement_m(load)[:, 16 - ny :, 15 - nx :]
    rows: tuple[int, ...] = (2, 0)
    part = compliance.convolution(rows, (0, 1, 2), window)(load[:, 16 - ny :, 15 - nx :])
    np.testing.assert_allclose(part, whole[list(rows)], atol=1e-13 * np.abs(whole).max())


def test_rough_stiffness_is_symmetric_positive_and_nearly_inverse():
    rng = np.random.default_rng(3)
    shape = (20, 24)
    stiffness = RoughStiffness(shape)
    a, b = rng.normal(size=(2, 1, *shape))
    assert np.vdot(a, stiffness(b)) == pytest.approx(np.vdot(b, stiffness(a)), rel=1e-12)
    compliance = SurfaceCompliance(HalfSpace(E, 0.5), shape, PITCH).convolution((2,), (2,), shape)
    unit = np.eye(shape[0] * shape[1]).reshape(-1, 1, *shape)
    dense = np.array([compliance(column).ravel() for column in unit])
    eased = np.array([stiffness(compliance(column)).ravel() for column in unit])
    raw, preconditioned = np.linalg.eigvalsh(dense), np.sort(np.linalg.eigvals(eased).real)
    assert preconditioned[0] > 0
    assert preconditioned[-1] / preconditioned[0] < 0.25 * raw[-1] / raw[0]


def test_refuses():
    with pytest.raises(ValueError, match=r"pitch_m is 0\.0"):
        SurfaceCompliance(HalfSpace(E, 0.3), (4, 4), 0.0)
    with pytest.raises(ValueError, match=r"shape is \(0, 4\)"):
        SurfaceCompliance(HalfSpace(E, 0.3), (0, 4), PITCH)
    compliance = SurfaceCompliance(HalfSpace(E, 0.3), (4, 5), PITCH)
    with pytest.raises(ValueError, match=r"shape \(3, 5, 4\), must be \(3, 4, 5\)"):
        compliance.displacement_m(np.zeros((3, 5, 4)))
    load: NDArray[np.float64] = np.zeros((3, 4, 5))
    load[1, 2, 3] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        compliance.displacement_m(load)
