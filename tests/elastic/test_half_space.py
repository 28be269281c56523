"""The half-space's transfer matrices against the equations of elasticity and the closed-form point loads."""

import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from resonator_daemon.arrays import Floats
from resonator_daemon.elastic import Convention, HalfSpace
from resonator_daemon.elastic.half_space import Input, Output

POISSON = [-0.7, 0.0, 0.3, 0.49, 0.5]
E = 2.0e5


# --- point loads (Boussinesq, Cerruti; Johnson, Contact Mechanics, eqs 3.19 and 3.75), summed over a Gaussian load


def normal_point_load(x: Floats, y: Floats, z: float, nu: float, mu: float) -> tuple[Floats, Floats]:
    """Displacement (3, ...) and stress (6, ...) of a unit normal force at the origin."""
    r, m = np.sqrt(x * x + y * y + z * z), 1 - 2 * nu
    u = [x * z / r**3 - m * x / (r * (r + z)), y * z / r**3 - m * y / (r * (r + z)), z * z / r**3 + 2 * (1 - nu) / r]
    shared = (2 * r + z) / (r * (r + z) ** 2)
    stress = [
        m * (z / r - r / (r + z) + x * x * shared) - 3 * x * x * z / r**3,
        m * (z / r - r / (r + z) + y * y * shared) - 3 * y * y * z / r**3,
        -3 * z**3 / r**3,
        m * x * y * shared - 3 * x * y * z / r**3,
        -3 * x * z * z / r**3,
        -3 * y * z * z / r**3,
    ]
    return np.array(u) / (4 * np.pi * mu), np.array(stress) / (2 * np.pi * r**2)


def tangential_point_load(x: Floats, y: Floats, z: float, nu: float, mu: float) -> tuple[Floats, Floats]:
    """Displacement and stress of a unit force along x at the origin."""
    r, m = np.sqrt(x * x + y * y + z * z), 1 - 2 * nu
    h = r + z
    u = [
        1 / r + x * x / r**3 + m * (1 / h - x * x / (r * h * h)),
        x * y / r**3 - m * x * y / (r * h * h),
        x * z / r**3 + m * x / (r * h),
    ]
    stress = [
        -3 * x**3 / r**5 + m * (x / r**3 - 3 * x / (r * h**2) + x**3 / (r**3 * h**2) + 2 * x**3 / (r**2 * h**3)),
        -3 * x * y * y / r**5
        + m * (x / r**3 - x / (r * h**2) + x * y * y / (r**3 * h**2) + 2 * x * y * y / (r**2 * h**3)),
        -3 * x * z * z / r**5,
        -3 * x * x * y / r**5 + m * (-y / (r * h**2) + x * x * y / (r**3 * h**2) + 2 * x * x * y / (r**2 * h**3)),
        -3 * x * x * z / r**5,
        -3 * x * y * z / r**5,
    ]
    return np.array(u) / (4 * np.pi * mu), np.array(stress) / (2 * np.pi)


SPREAD = 0.8e-3
PITCH = 4e-4
POINTS = [(0.0, 0.0), (2 * PITCH, 0.0), (-PITCH, 3 * PITCH), (6 * PITCH, -4 * PITCH)]


@functools.cache
def gaussian_load_fields(nu: float, z: float) -> dict[Output, Floats]:
    """Fields at POINTS of a unit Gaussian load along x, y, z: output -> (points, rows, 3), by the trapezoidal rule."""
    mu = E / (2 * (1 + nu))
    axis = np.arange(-110, 111) * (6.9e-3 / 110)
    a, b = np.meshgrid(axis, axis)
    weight = np.exp(-(a * a + b * b) / (2 * SPREAD**2)) / (2 * np.pi * SPREAD**2) * (axis[1] - axis[0]) ** 2
    displacement, stress = np.empty((len(POINTS), 3, 3)), np.empty((len(POINTS), 6, 3))
    for point, (x, y) in enumerate(POINTS):
        for column, (load, swap) in enumerate(
            [(tangential_point_load, False), (tangential_point_load, True), (normal_point_load, False)]
        ):
            dx, dy = x - a, y - b
            u, s = load(dy, dx, z, nu, mu) if swap else load(dx, dy, z, nu, mu)
            if swap:
                u, s = u[[1, 0, 2]], s[[1, 0, 2, 3, 5, 4]]
            displacement[point, :, column] = (u * weight).sum((1, 2))
            stress[point, :, column] = (s * weight).sum((1, 2))
    trace = stress[:, :3].sum(axis=1, keepdims=True)
    strain = (1 + nu) / E * stress
    strain[:, :3] -= nu / E * trace
    return {
        "displacement": displacement,
        "stress": stress,
        "strain": strain,
        "p_n": trace / 3,
        "sensor": np.concatenate([trace / (2 * E), strain[:, 4:]], axis=1),
    }


def polar_frequencies(z: float) -> tuple[Floats, Floats, Floats]:
    """Frequencies and weights of the inverse transform in polar form; no sample at omega = 0, no period."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    edges = np.linspace(0.0, min(9.0 / SPREAD, 40.0 / z), 8)
    half = np.diff(edges)[:, None] / 2
    w = (edges[:-1, None] + half * (1 + nodes)).ravel()
    angle = np.arange(160) * (2 * np.pi / 160)
    area = ((half * weights).ravel() * w)[:, None] * np.full(160, 2 * np.pi / 160) / (4 * np.pi**2)
    return np.outer(w, np.cos(angle)), np.outer(w, np.sin(angle)), area


def surface_displacement_spectrum(wx: Floats, wy: Floats, nu: float) -> NDArray[np.complex128]:
    """Transform of the point loads' displacement at z = 0, (..., 3, 3), from those of 1/r, x/r^2, x^2/r^3, xy/r^3."""
    w, m = np.hypot(wx, wy), 1 - 2 * nu
    inverse_r = 2 * np.pi / w
    x_r2, y_r2 = -2j * np.pi * wx / w**2, -2j * np.pi * wy / w**2
    xx_r3, yy_r3, xy_r3 = 2 * np.pi / w**3 * np.array([wy * wy, wx * wx, -wx * wy])
    rows = [
        [(1 + m) * inverse_r + (1 - m) * xx_r3, (1 - m) * xy_r3, -m * x_r2],
        [(1 - m) * xy_r3, (1 + m) * inverse_r + (1 - m) * yy_r3, -m * y_r2],
        [m * x_r2, m * y_r2, (1 + m) * inverse_r],
    ]
    mu = E / (2 * (1 + nu))
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1)) / (4 * np.pi * mu)


@pytest.mark.parametrize("source", ["traction", "displacement"])
@pytest.mark.parametrize("z", [0.5e-3, 2.0e-3])
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])
def test_gaussian_load_agrees_with_superposed_point_loads(nu: float, z: float, source: Input):
    """The load itself as traction, or the displacement of the surface under it, brings about its inner fields."""
    body = HalfSpace(E, nu)
    wx, wy, area = polar_frequencies(z)
    load = np.exp(-(SPREAD**2) * (wx * wx + wy * wy) / 2)[..., None, None] * np.eye(3)
    if source == "displacement":
        load = surface_displacement_spectrum(wx, wy, nu) @ load
    phases = np.array([np.exp(1j * (wx * x + wy * y)) for x, y in POINTS]) * area
    for output, expected in gaussian_load_fields(nu, z).items():
        fields = body.transfer_matrix(output, source, wx, wy, z) @ load
        found = np.tensordot(phases, fields, 2)
        error = np.abs(found - expected).max(axis=0) / np.abs(expected).max()
        assert error.max() < 1e-11, (output, error)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49, 0.5])
def test_surface_displacement_of_a_gaussian_load_brings_back_the_load(nu: float):
    wx, wy, area = polar_frequencies(SPREAD)
    load = np.exp(-(SPREAD**2) * (wx * wx + wy * wy) / 2) * area
    phases = np.array([np.exp(1j * (wx * x + wy * y)) for x, y in POINTS]) * load
    stiffness = HalfSpace(E, nu).transfer_matrix("traction", "displacement", wx, wy, 0.0)
    found = np.tensordot(phases, stiffness @ surface_displacement_spectrum(wx, wy, nu), 2)
    bell = np.array([np.exp(-(x * x + y * y) / (2 * SPREAD**2)) for x, y in POINTS]) / (2 * np.pi * SPREAD**2)
    np.testing.assert_allclose(found, bell[:, None, None] * np.eye(3), atol=1e-11 * bell.max(), rtol=0)


# --- omega = 0


@pytest.mark.parametrize("output", ["strain", "stress", "p_n", "sensor"])
@pytest.mark.parametrize("nu", POISSON)
def test_isolated_value_is_the_mean_over_directions(nu: float, output: Output):
    body = HalfSpace(E, nu)
    angle = np.arange(64) * (2 * np.pi / 64)
    near_zero = body.transfer_matrix(output, "traction", 1e-9 * np.cos(angle), 1e-9 * np.sin(angle), 1e-3).mean(axis=0)
    at_zero = body.transfer_matrix(output, "traction", 0.0, 0.0, 1e-3)
    np.testing.assert_allclose(at_zero, near_zero, atol=1e-11 * np.abs(at_zero).max())


@pytest.mark.parametrize("output", ["displacement", "strain", "stress", "p_n", "sensor", "traction"])
def test_displacement_input_has_its_true_limit(output: Output):
    body = HalfSpace(E, 0.3)
    near_zero = body.transfer_matrix(output, "displacement", 6e-10, 8e-10, 0.0)
    at_zero = body.transfer_matrix(output, "displacement", 0.0, 0.0, 0.0, zero="periodic")
    np.testing.assert_allclose(at_zero, near_zero, atol=1e-3 if output in ("stress", "p_n", "traction") else 1e-8)


@pytest.mark.parametrize("nu", POISSON)
def test_periodic_value_is_the_laterally_confined_body(nu: float):
    """Uniform traction: no strain across, Hooke's law, and a displacement that is the integral of the strain."""
    body = HalfSpace(E, nu)
    strain = body.transfer_matrix("strain", "traction", 0.0, 0.0, 1e-3, zero="periodic").real
    stress = body.transfer_matrix("stress", "traction", 0.0, 0.0, 1e-3, zero="periodic").real
    np.testing.assert_array_equal(stress[[4, 5, 2]], -np.eye(3))
    np.testing.assert_array_equal(strain[[0, 1, 3]], 0.0)
    compliance = (1 + nu) / E * stress
    compliance[:3] -= nu / E * stress[:3].sum(axis=0)
    np.testing.assert_allclose(strain, compliance, atol=1e-15 / E)
    p_n = body.transfer_matrix("p_n", "traction", 0.0, 0.0, 1e-3, zero="periodic").real
    np.testing.assert_allclose(p_n[0], stress[:3].mean(axis=0), atol=1e-15)
    sensor = body.transfer_matrix("sensor", "traction", 0.0, 0.0, 1e-3, zero="periodic").real
    np.testing.assert_allclose(sensor, [1.5 / E * p_n[0], strain[4], strain[5]], rtol=1e-14)
    depths = np.array([0.0, 1e-3])
    moved = body.transfer_matrix("displacement", "traction", 0.0, 0.0, depths, zero="periodic").real
    slope = (moved[1] - moved[0]) / 1e-3
    np.testing.assert_allclose(slope, np.diag([2 * strain[4, 0], 2 * strain[5, 1], strain[2, 2]]), rtol=1e-12)
    np.testing.assert_array_equal(moved[0], 0.0)


@pytest.mark.parametrize("nu", POISSON)
def test_mean_displacement_falls_with_depth_as_that_of_long_waves_in_all_directions(nu: float):
    body, depths, long = HalfSpace(E, nu), np.array([0.0, 1e-3]), 1e-3
    wx, wy = long * np.array([1.0, 0.0, -1.0, 0.0]), long * np.array([0.0, 1.0, 0.0, -1.0])
    waves = [body.transfer_matrix("displacement", "traction", x, y, depths) for x, y in zip(wx, wy, strict=True)]
    mean = np.mean(waves, axis=0).real
    moved = body.transfer_matrix("displacement", "traction", 0.0, 0.0, depths, period_m=0.1).real
    np.testing.assert_allclose(moved[1] - moved[0], mean[1] - mean[0], atol=1e-5 * 1e-3 / E)


def test_zero_frequency_can_be_refused():
    with pytest.raises(ValueError, match="omega is 0"):
        HalfSpace(E, 0.5).transfer_matrix("p_n", "traction", [1.0, 0.0], 0.0, 0.0, zero="raise")


# --- what the caller's numbers mean

STRESS, PRESSURE = Convention(traction_is_stress=True), Convention(p_n_is_pressure=True)


@pytest.mark.parametrize("wx", [0.0, 700.0])
def test_traction_can_be_the_stress_at_the_surface(wx: float):
    body = HalfSpace(E, 0.3)
    stress = body.transfer_matrix("stress", "traction", wx, wx, 0.0, convention=STRESS)
    np.testing.assert_allclose(stress[[4, 5, 2]], np.eye(3), atol=1e-15)
    moved = body.transfer_matrix("displacement", "traction", wx, wx, 0.0, period_m=1.0, convention=STRESS)
    assert moved[2, 2].real < 0  # tension lifts the surface
    held = body.transfer_matrix("traction", "displacement", 700.0, 0.0, 0.0, convention=STRESS)
    inside = body.transfer_matrix("stress", "displacement", 700.0, 0.0, 0.0, convention=STRESS)
    np.testing.assert_allclose(held, inside[[4, 5, 2]], atol=1e-12 * np.abs(held).max())


@pytest.mark.parametrize("source", ["traction", "displacement"])
@pytest.mark.parametrize("wx", [0.0, 700.0])
def test_p_n_can_be_a_pressure(wx: float, source: Input):
    body = HalfSpace(E, 0.3)
    both = Convention(traction_is_stress=True, p_n_is_pressure=True)
    for convention in (PRESSURE, both):
        stress = body.transfer_matrix("stress", source, wx, wx, 1e-3, convention=convention)
        strain = body.transfer_matrix("strain", source, wx, wx, 1e-3, convention=convention)
        p_n = body.transfer_matrix("p_n", source, wx, wx, 1e-3, convention=convention)
        sensor = body.transfer_matrix("sensor", source, wx, wx, 1e-3, convention=convention)
        np.testing.assert_allclose(p_n[0], -stress[:3].sum(axis=0) / 3, atol=1e-14 * np.abs(stress).max())
        np.testing.assert_allclose(sensor, [1.5 / E * p_n[0], strain[4], strain[5]], rtol=1e-13)
    pressed = body.transfer_matrix("p_n", "traction", 0.0, 0.0, 1e-3, convention=PRESSURE)
    assert pressed[0, 2].real > 0


# --- shapes


def test_frequencies_and_depths_broadcast():
    body = HalfSpace(E, 0.3)
    wx, wy, z = np.array([1.0, 2.0, 3.0]), np.array([[0.5], [0.0]]), np.array([0.0, 1e-3])[:, None, None]
    stacked = body.transfer_matrix("strain", "traction", wx, wy, z)
    assert stacked.shape == (2, 2, 3, 6, 3)
    assert stacked.dtype == np.complex128
    single = body.transfer_matrix("strain", "traction", 3.0, 0.5, 1e-3)
    assert single.shape == (6, 3)
    np.testing.assert_array_equal(stacked[1, 0, 2], single)
    zeros = body.transfer_matrix("p_n", "traction", [0.0, 1.0], 0.0, [[0.0], [1.0]])
    assert zeros.shape == (2, 2, 1, 3)
    assert np.isfinite(zeros).all()
