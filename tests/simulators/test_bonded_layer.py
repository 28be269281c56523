"""Signals in a skin on a rigid plate: against equations of state over its thickness, and in a skin without end."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.linalg import expm

from resonator_daemon.base.arrays import Floats
from simulators.contact import hertz_parts
from simulators.pressed_surface import PressedSurface

E, DEPTH_M, RADIUS_M, FORCE_NEWTON = 2e5, 1e-3, 2.5e-3, np.array([0.3, -0.2, 1.0])
PIXELS, PITCH_M = 256, 2e-4
EVERY = np.arange(-20, 21, 4)  # pixels from the centre at which signals are compared
SITES_M = np.stack(np.meshgrid(EVERY, EVERY), axis=-1).reshape(-1, 2) * PITCH_M


def transfer(k: float, nu: float, thickness_m: float) -> Floats:
    """Return p_n and stress_lz / j under f_z = 1, the same under j f_l = 1, and stress_tz under f_t = 1.

    (u_l / j, u_z, stress_lz / j, stress_zz)' = state @ it is Hooke's law with equilibrium; the plate holds u at 0.
    """
    mu, ratio = E / (2 * (1 + nu)), nu / (1 - nu)
    state = np.zeros((4, 4))
    state[0, 1:3] = -k, 1 / mu
    state[1, [0, 3]] = ratio * k, (1 - 2 * nu) / (2 * mu * (1 - nu))
    state[2, [0, 3]] = 2 * mu * k**2 / (1 - nu), -ratio * k
    state[3, 2] = k
    to_depth, to_plate = expm(state * DEPTH_M), expm(state * thickness_m)
    found = []
    for stress in ([0.0, -1.0], [1.0, 0.0]):
        moved = np.linalg.solve(to_plate[:2, :2], -to_plate[:2, 2:] @ stress)
        u_l, _, shear, normal = to_depth @ [*moved, *stress]
        along = -2 * mu * k * u_l / (1 - nu) + ratio * normal
        found += [(1 + nu) / 3 * (along + normal), shear]
    return np.array([*found, -np.cosh(k * (thickness_m - DEPTH_M)) / np.cosh(k * thickness_m)])


def expected_signals(nu: float, thickness_m: float, punch: tuple[float, float]) -> Floats:
    """Return the signals (3, n) at SITES_M under a load in the centre, by Fourier series."""
    omega = 2 * np.pi * np.fft.fftfreq(PIXELS, PITCH_M)
    x, y = np.meshgrid(omega, omega)
    k = np.hypot(x, y)
    c, s = np.where(k > 0, [x, y] / np.maximum(k, 1e-9), [[[1.0]], [[0.0]]])
    knots = np.concatenate([[1.0], np.linspace(20.0, 12e3, 1200)])
    spline = CubicSpline(knots, [transfer(each, nu, thickness_m) for each in knots])
    p_z, s_z, p_l, s_l, s_t = np.moveaxis(np.where(k[..., None] < 12e3, spline(np.minimum(k, 12e3)), 0.0), -1, 0)
    ka = np.maximum(k * RADIUS_M, 1e-3)
    hertz, flat = 3 * (np.sin(ka) - ka * np.cos(ka)) / ka**3, np.sin(ka) / ka
    tangential, normal = (hertz + share * (flat - hertz) for share in punch)
    f_l, f_t = (c * FORCE_NEWTON[0] + s * FORCE_NEWTON[1]), (c * FORCE_NEWTON[1] - s * FORCE_NEWTON[0])
    f_l, f_t, f_z = 1j * f_l * tangential, f_t * tangential, FORCE_NEWTON[2] * normal
    stress_l, stress_t = 1j * (s_z * f_z + s_l * f_l), s_t * f_t
    to_strain = (1 + nu) / E
    signals = [
        p_z * f_z + p_l * f_l,
        (c * stress_l - s * stress_t) * to_strain,
        (s * stress_l + c * stress_t) * to_strain,
    ]
    fields = np.fft.ifft2(signals).real / PITCH_M**2
    return np.asarray(fields[:, EVERY[:, None], EVERY].reshape(3, -1))


def surface(nu: float, thickness_m: float, punch: tuple[float, float]) -> PressedSurface:
    return PressedSurface(SITES_M, DEPTH_M, E, nu, 20e-3, 8e-3, punch=punch, thickness_m=thickness_m)


@pytest.mark.parametrize("punch", [(0.0, 0.0), (1.0, 1.0), (0.0, -0.3)], ids=["ball", "punch", "adhesion"])
@pytest.mark.parametrize(("nu", "thickness_m"), [(0.5, 3e-3), (0.3, 2e-3)])
def test_layer_agrees_with_its_equations_of_state(nu: float, thickness_m: float, punch: tuple[float, float]) -> None:
    load = np.array([[RADIUS_M, 0.0]]), np.array([[FORCE_NEWTON, np.zeros(3)]])
    (found,) = surface(nu, thickness_m, punch).signals((0.0, 0.0), *load)
    expected = expected_signals(nu, thickness_m, punch)
    assert np.abs((found - expected) / np.abs(expected).max(axis=1, keepdims=True)).max() < 1e-4


def test_a_thick_layer_is_a_half_space() -> None:
    load = hertz_parts([FORCE_NEWTON], RADIUS_M, 0.5)
    without_end = surface(0.5, np.inf, (0.0, 0.0)).signals((0.0, 0.0), *load)
    layers = (surface(0.5, thickness_m, (0.0, 0.0)).signals((0.0, 0.0), *load) for thickness_m in (0.1, 1.0))
    off, least = (np.abs(layer - without_end).max() / np.abs(without_end).max() for layer in layers)
    assert least < 1e-4
    assert off / least == pytest.approx(100.0, rel=0.05)  # the plate's reaction is a stress, force over its square
