"""The prior's covariances against adaptive quadrature of other formulas and against Fourier transforms of samples."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import jv

from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.open_plane.prior_tables import StationaryPrior
from resonator_daemon.estimate.surface.skin import Prior

L, Z, RATIO, STD = 1.3e-3, 0.8e-3, 0.3, 700.0


def prior(nu: float = 0.5) -> StationaryPrior:
    return StationaryPrior(HalfSpace(2e5, nu), Prior(L, RATIO), STD)


def hankel(order: int, of_t, distance_m: float, depths: float) -> float:
    """Integral of p g J_n with exp(-depths t), t = omega Z, in the prior's unit."""
    r = distance_m / Z
    value, _ = quad(
        lambda t: of_t(t) * np.exp(-depths * t) * jv(order, t * r) * t / (1 + (t * L / Z) ** 2) ** 2,
        0,
        40 / depths,
        limit=2000,
        epsabs=1e-13,
    )
    return 4 * np.pi * L**2 * STD**2 / Z**2 * value / (2 * np.pi)


@pytest.mark.parametrize("nu", [0.0, 0.5])
@pytest.mark.parametrize("angle", [0.7, 3.5])
@pytest.mark.parametrize("distance_m", [0.23e-3, 2.3e-3, 9e-3])
def test_closed_radial_forms(nu: float, angle: float, distance_m: float):
    """The angular orders worked out by hand, for the sensor's three rows."""
    mu = 2e5 / (2 * (1 + nu))
    c, s, c2, s2 = np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)
    a = hankel(0, lambda t: RATIO + 1, distance_m, 2)
    b = hankel(1, lambda t: RATIO * (t - 1) + t, distance_m, 2)
    flat = hankel(0, lambda t: RATIO, distance_m, 2)
    d0, d2 = (hankel(n, lambda t: RATIO * (t * t - 2 * t) + t * t, distance_m, 2) for n in (0, 2))
    signals = [
        [a, -c * b, -s * b],
        [c * b, flat + (d0 - c2 * d2) / 2, -s2 * d2 / 2],
        [s * b, -s2 * d2 / 2, flat + (d0 + c2 * d2) / 2],
    ]
    offset = distance_m * np.array([c, s])
    found = prior(nu).kernel("sensor", Z, "sensor", Z, 0.02)(offset) * 4 * mu**2
    assert found == pytest.approx(np.array(signals), abs=1e-5 * STD**2)

    g0, g1 = (hankel(n, lambda t: 1.0, distance_m, 1) for n in (0, 1))
    h0, h1, h2 = (hankel(n, lambda t: t, distance_m, 1) for n in (0, 1, 2))
    q = RATIO
    surface = [
        [q * c * g1, q * (-g0 + (h0 - c2 * h2) / 2), -q * s2 * h2 / 2],
        [q * s * g1, -q * s2 * h2 / 2, q * (-g0 + (h0 + c2 * h2) / 2)],
        [-g0, c * h1, s * h1],
    ]
    found = prior(nu).kernel("traction", 0.0, "sensor", Z, 0.02)(offset) * 2 * mu
    assert found == pytest.approx(np.array(surface), abs=1e-5 * STD**2)


def test_displacement_of_an_incompressible_skin():
    """At nu = 1/2 f_z alone moves the surface along z: omega u_z = f_z / (2 mu)."""
    mu = 2e5 / 3
    offset = 1.7e-3 * np.array([np.cos(0.4), np.sin(0.4)])
    found = prior().kernel("displacement", 0.0, "sensor", Z, 0.02)(offset)[2, 0]
    expected = -hankel(0, lambda t: Z / t, 1.7e-3, 1) / (2 * mu)
    assert found * 2 * mu == pytest.approx(expected, rel=1e-5)
