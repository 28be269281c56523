"""Signals at the sites of a load spread over a disc, by Hankel integrals of the half-space's transfer matrices."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import hyp0f1

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.decoded import positions, positive
from resonator_daemon.estimate.surface.fitting.slip_signals import SlipSignals, distance_knots
from resonator_daemon.estimate.surface.layout import diagonal_m

POWERS = 0.5, -0.5, 0.0  # of the pressures that discs may have
_FADED = 40.0  # spatial frequency times depth at which signals have faded to exp(-40)
_PANEL_NODES = 16
_PANEL_PHASE = 20.0  # of the fastest oscillation, that one panel of Gauss-Legendre may span: error 1e-12
_BLOCK = 1_000_000  # entries of an array of quadrature nodes and distances
_RADIUS_STEP = 0.2  # depths
_BEYOND = 0.5  # of the array's diagonal, that a centre may lie outside of it


class DiscModel:
    """Signals [3 p_n / (2 E), eps_xz, eps_yz] of forces that are spread over a disc.

    In units of the depth z, with t = omega z, the spectrum H(t a / z) of the pressure and T(t) the transfer matrix of a
    wave along x, every signal is an integral of T H over t, times J_0, J_1 or J_2 of t r / z and 1 / z^2. The five that
    differ are tabulated once over r / z and a / z, with their slopes.

    Parameters
    ----------
    half_space
    site_positions_m
        (n, 2).
    depth_m
        Of all sites; above 0.
    radius_max_m
        Largest radius of the disc.
    power
        p of `POWERS`: the pressure is proportional to (1 - r^2 / a^2)^p, and the spectrum of a unit force is 0F1(p + 2,
        -(omega a)^2 / 4) (Sneddon, Fourier Transforms, 1951). 0.5 is a paraboloid, -0.5 a flat punch, 0 even pressure.

    Attributes
    ----------
    slip
        Signals of contacts in partial slip, and their slopes; of discs alone, if the margin is 0.

    Raises
    ------
    ValueError
        A shape that does not fit, a depth or radius not above 0, another power.
    """

    def __init__(
        self,
        half_space: HalfSpace,
        site_positions_m: ArrayLike,
        depth_m: float,
        radius_max_m: float,
        power: float = 0.5,
    ) -> None:
        sites = positions("site_positions_m", site_positions_m)
        positive("depth_m", depth_m, ())
        positive("radius_max_m", radius_max_m, ())
        self.sites_m = sites
        self.radius_max_m = radius_max_m
        self.lowest_m, self.highest_m = sites.min(axis=0), sites.max(axis=0)
        self.depth_m = depth_m
        extent_m = diagonal_m(sites, np.full(len(sites), depth_m))
        self.margin_m = _BEYOND * extent_m  # beyond the sites, where a centre may lie
        of_power = POWERS.index(power)
        knots, value, slope = _integrals(half_space, 2.0 * extent_m / depth_m, radius_max_m / depth_m)
        self.slip = SlipSignals(sites, depth_m, knots, value[of_power], slope[of_power], _RADIUS_STEP)


@lru_cache(maxsize=2)  # of all powers, which have the same Bessel functions, and of a skin whose noise changes
def _integrals(half_space: HalfSpace, reach: float, radius_max: float) -> tuple[Floats, Floats, Floats]:
    """Return distances in depths (d,), integrals there, and (1/r) d/dr of them.

    Integrals are (powers; radii; value, slope by radius times the step; 5; d), in the order pressed, along for p, along
    for strain, sheared, turned.
    """
    radii = np.arange(2 + int(np.ceil(radius_max / _RADIUS_STEP))) * _RADIUS_STEP
    distances = distance_knots(reach)
    t, weights = _quadrature(distances[-1] + radii[-1])

    # A wave along x: x is along it, y across; what is odd in the direction is imaginary.
    matrix = half_space.transfer_matrix("sensor", "traction", t, 0.0, 1.0)
    along, across = matrix[:, 1, 0].real, matrix[:, 2, 1].real
    rows = [matrix[:, 0, 2].real, -matrix[:, 0, 0].imag, -matrix[:, 1, 2].imag]
    integrands = np.array([*rows, (along + across) / 2.0, (across - along) / 2.0]) * (weights * t / (2.0 * np.pi))
    k = np.multiply.outer(radii, t)
    spectra = np.empty((len(POWERS), radii.size, 2, t.size))
    for power, (value, slope) in zip(POWERS, spectra.transpose(0, 2, 1, 3), strict=True):
        value[:] = hyp0f1(power + 2.0, -(k**2) / 4.0)
        slope[:] = -k / (2.0 * (power + 2.0)) * hyp0f1(power + 3.0, -(k**2) / 4.0) * t * _RADIUS_STEP

    # J_n(x) / x^n, so that nothing is divided by the distance at a site.
    values, slopes = np.empty((2, *spectra.shape[:-1], len(integrands), distances.size))
    block = 1 + _BLOCK // t.size
    for begin in range(0, distances.size, block):
        some = slice(begin, begin + block)
        squares = np.multiply.outer(distances[some], t) ** 2 / -4.0
        zero, one, two, three = (hyp0f1(n + 1, squares) / scale for n, scale in enumerate((1.0, 2.0, 8.0, 48.0)))
        kernels = (zero, t * one, t * one, zero, t**2 * two)
        by_distance = (-(t**2) * one, -(t**3) * two, -(t**3) * two, -(t**2) * one, -(t**4) * three)
        for index, integrand in enumerate(integrands):
            values[..., index, some] = (spectra * integrand) @ kernels[index].T
            slopes[..., index, some] = (spectra * integrand) @ by_distance[index].T
    return distances, values, slopes


def _quadrature(reach: float) -> tuple[Floats, Floats]:
    """Return the nodes and weights over 0 .. 40, fine enough for phases up to `reach` times the node."""
    edges = np.linspace(0.0, _FADED, 1 + int(np.ceil(_FADED * max(reach, 1.0) / _PANEL_PHASE)))
    nodes, weights = np.polynomial.legendre.leggauss(_PANEL_NODES)
    half = (edges[1] - edges[0]) / 2.0
    return (edges[:-1, None] + half * (nodes + 1.0)).ravel(), np.tile(half * weights, edges.size - 1)
