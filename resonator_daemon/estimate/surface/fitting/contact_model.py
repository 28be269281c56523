"""Signals at the sites of a load spread over a disc, by Hankel integrals of the half-space's transfer matrices."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import j0, j1

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.decoded import positions, positive
from resonator_daemon.estimate.surface.fitting.slip_signals import SlipSignals
from resonator_daemon.estimate.surface.layout import diagonal_m

Profile = Literal["hertz", "flat"]

_FADED = 40.0  # spatial frequency times depth at which signals have faded to exp(-40)
_PANEL_NODES = 16
_PANEL_PHASE = 20.0  # of the fastest oscillation, that one panel of Gauss-Legendre may span: error 1e-12
_DISTANCE_STEP = 0.1  # depths; the table is good to about 1e-5 of the peak
_BLOCK = 1_000_000  # entries of an array of quadrature nodes and distances
_RADIUS_STEP = 0.2  # depths
_BEYOND = 0.5  # of the array's diagonal, that a centre may lie outside of it


@dataclass(frozen=True)
class DiscSignals:
    """Signals of unit forces and their derivatives; all of shape (force x, y, z; signal; n), in 1/N or 1/(N m)."""

    value: Floats
    by_radius: Floats
    by_x: Floats  # of the centre
    by_y: Floats


class DiscModel:
    """Signals [3 p_n / (2 E), eps_xz, eps_yz] of forces whose traction over a disc has a fixed profile.

    In units of the depth z, with t = omega z, the spectrum H(t a / z) of the profile and T(t) the transfer matrix of a
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
    profile
        "hertz", 3 / (2 pi a^2) sqrt(1 - r^2 / a^2) per newton, whose spectrum is 3 (sin k - k cos k) / k^3 at k = omega
        a, or "flat", 1 / (2 pi a^2) / sqrt(1 - r^2 / a^2), sin k / k (Sneddon, Fourier Transforms, 1951): the pressure
        of a paraboloid and that of a flat punch.

    Raises
    ------
    ValueError
        A shape that does not fit, a depth or radius not above 0.
    """

    def __init__(
        self,
        half_space: HalfSpace,
        site_positions_m: ArrayLike,
        depth_m: float,
        radius_max_m: float,
        profile: Profile = "hertz",
    ) -> None:
        sites = positions("site_positions_m", site_positions_m)
        positive("depth_m", depth_m, ())
        positive("radius_max_m", radius_max_m, ())
        if profile not in ("hertz", "flat"):
            raise ValueError(f"profile is {profile!r}, must be 'hertz' or 'flat'")
        self.half_space = half_space
        self.sites_m = sites
        self.radius_max_m = radius_max_m
        self.lowest_m, self.highest_m = sites.min(axis=0), sites.max(axis=0)
        self.depth_m = depth_m
        extent_m = diagonal_m(sites, np.full(len(sites), depth_m))
        self.margin_m = _BEYOND * extent_m  # beyond the sites, where a centre may lie
        self._table = _table(half_space, 2.0 * extent_m / depth_m, radius_max_m / depth_m, profile)

    def signals(self, centre_m: Floats, radius_m: float) -> DiscSignals:
        """Return the signals of unit forces on a disc, and their derivatives.

        `centre_m` (2,) within `margin_m` of the sites, `radius_m` in 0 .. `radius_max_m`: else ValueError.
        """
        if not 0.0 <= radius_m <= self.radius_max_m * (1.0 + 1e-9):
            raise ValueError(f"radius_m is {radius_m}, must be in 0 .. {self.radius_max_m}")
        outside_m = np.maximum(self.lowest_m - centre_m, centre_m - self.highest_m).max()
        if not outside_m <= self.margin_m * (1.0 + 1e-9):
            raise ValueError(f"centre_m lies {outside_m} m outside the sites, must be within {self.margin_m}")
        depth_m = self.depth_m
        x, y = np.ascontiguousarray((self.sites_m - centre_m).T) / depth_m
        distance = np.hypot(x, y)
        radial, by_distance, by_radius = self._radial(distance, radius_m / depth_m)
        slope = by_distance / np.where(distance > 0.0, distance, 1.0)  # all slopes are 0 at distance 0
        by_x, by_y = _tensor(x, y, -x * slope), _tensor(x, y, -y * slope)
        _, along_p, along_eps, _, turned = radial
        by_x[0, 0] -= along_p
        by_y[1, 0] -= along_p
        by_x[2, 1] -= along_eps
        by_y[2, 2] -= along_eps
        twice_x, twice_y = 2.0 * x * turned, 2.0 * y * turned
        by_x[0, 1] -= twice_x
        by_x[1, 2] += twice_x
        by_x[0, 2] -= twice_y
        by_y[0, 1] += twice_y
        by_y[1, 2] -= twice_y
        by_y[0, 2] -= twice_x
        by_x[1, 1], by_y[1, 1] = by_x[0, 2], by_y[0, 2]
        per_area, per_volume = depth_m**-2, depth_m**-3
        return DiscSignals(
            _tensor(x, y, radial) * per_area,
            _tensor(x, y, by_radius) * per_volume,
            by_x * per_volume,
            by_y * per_volume,
        )

    @cached_property
    def slip(self) -> SlipSignals:
        """Signals of contacts in partial slip, for the Hertz profile; made at first use."""
        reach = (self._table.shape[2] - 3) * _DISTANCE_STEP
        return SlipSignals(self.sites_m, self.depth_m, self.radial, reach, _RADIUS_STEP)

    def radial(self, distance: Floats) -> tuple[Floats, Floats]:
        """Interpolate the five integrals over distance (n,), in depths, and their slopes by it: at all radii.

        Each (radii; value, slope by radius times the step; 5; n), in the order pressed, along for p, along for strain,
        sheared, turned.
        """
        place = distance / _DISTANCE_STEP
        knots = np.minimum(place.astype(np.intp), self._table.shape[2] - 2)
        weights, slopes = (part.reshape(2, 2, 1, 1, 1, -1) for part in _hermite(place - knots))
        # (distance knot; value, slope; radii; value, slope; 5; n)
        near = np.stack([self._table[:, :, knots], self._table[:, :, knots + 1]]).transpose(0, 4, 1, 2, 5, 3)
        return (weights * near).sum(axis=(0, 1)), (slopes * near).sum(axis=(0, 1)) / _DISTANCE_STEP

    def _radial(self, distance: Floats, radius: float) -> tuple[Floats, Floats, Floats]:
        """Interpolate the five integrals and their slopes by distance and by radius, (5, n) each: bicubic Hermite."""
        knot = min(int(radius / _RADIUS_STEP), len(self._table) - 2)
        weights, slopes = _hermite(radius / _RADIUS_STEP - knot)
        rows = self._table[knot : knot + 2].reshape(4, -1)  # value and slope at the lower, then at the upper knot
        # (knots of distance; value and slope along it; at the radius and by it; 5)
        profile = np.stack([weights @ rows, slopes @ rows]).reshape(2, -1, 2, 5).transpose(1, 2, 0, 3)
        pairs = np.concatenate([profile[:-1], profile[1:]], axis=1).reshape(len(profile) - 1, 40).T
        place = distance / _DISTANCE_STEP
        knots = place.astype(np.intp)
        weights, slopes = _hermite(place - knots)
        near = pairs.take(knots, axis=1).reshape(4, 10, -1)
        found = (weights[:, None] * near).sum(axis=0)
        by_distance = (slopes[:, None] * near[:, :5]).sum(axis=0) / _DISTANCE_STEP
        return found[:5], by_distance, found[5:] / _RADIUS_STEP


def _tensor(x: Floats, y: Floats, radial: Floats) -> Floats:
    """Put the five integrals (5, n) together to (force, signal, n)."""
    pressed, along_p, along_eps, sheared, turned = radial
    tensor = np.empty((3, 3, x.size))
    tensor[0, 0], tensor[1, 0], tensor[2, 0] = x * along_p, y * along_p, pressed
    tensor[2, 1], tensor[2, 2] = x * along_eps, y * along_eps
    difference = (x * x - y * y) * turned
    tensor[0, 1], tensor[1, 2] = sheared + difference, sheared - difference
    tensor[0, 2] = tensor[1, 1] = 2.0 * x * y * turned
    return tensor


def _hermite(fraction: Floats | float) -> tuple[Floats, Floats]:
    """Return weights of value and slope at both ends of a unit interval, lower end first, and their slopes."""
    f = np.asarray(fraction)
    rest = 1.0 - f
    weights = np.array([rest**2 * (1.0 + 2.0 * f), rest**2 * f, f**2 * (3.0 - 2.0 * f), -(f**2) * rest])
    slopes = np.array([-6.0 * f * rest, rest * (1.0 - 3.0 * f), 6.0 * f * rest, f * (3.0 * f - 2.0)])
    return weights, slopes


@lru_cache(maxsize=4)  # a skin whose noise changes gets another model over the same table
def _table(half_space: HalfSpace, reach: float, radius_max: float, profile: Profile) -> Floats:
    """Return integrals at knots in depths: (radii; value, slope; distances; value, slope; 5)."""
    radii = np.arange(2 + int(np.ceil(radius_max / _RADIUS_STEP))) * _RADIUS_STEP
    distances = np.arange(3 + int(np.ceil(reach / _DISTANCE_STEP))) * _DISTANCE_STEP
    t, weights = _quadrature(distances[-1] + radii[-1])

    # A wave along x: x is along it, y across; what is odd in the direction is imaginary.
    matrix = half_space.transfer_matrix("sensor", "traction", t, 0.0, 1.0)
    along, across = matrix[:, 1, 0].real, matrix[:, 2, 1].real
    integrands = np.array(
        [
            matrix[:, 0, 2].real,
            -matrix[:, 0, 0].imag,
            -matrix[:, 1, 2].imag,
            (along + across) / 2,
            -(along - across) / 2,
        ]
    ) * (weights * t / (2.0 * np.pi))
    spectrum, spectrum_slope = _spectrum(np.multiply.outer(radii, t), profile)
    spectra = np.stack([spectrum, spectrum_slope * t * _RADIUS_STEP], axis=1)

    # J_1 and J_2 over the first and second power of the distance, so that nothing is divided by it at a site.
    table = np.empty((radii.size, 2, distances.size, 2, 5))
    block = 1 + _BLOCK // t.size
    for begin in range(0, distances.size, block):
        some = slice(begin, begin + block)
        phase = np.multiply.outer(distances[some], t)
        zero, one, two, three = _bessel(phase)
        kernels = (zero, t * one, t * one, zero, t**2 * two)
        bent = t**2 * phase * two
        slopes = (-t * phase * one, -bent, -bent, -t * phase * one, -(t**3) * phase * three)
        for index, integrand in enumerate(integrands):
            table[:, :, some, 0, index] = (spectra * integrand) @ kernels[index].T
            table[:, :, some, 1, index] = (spectra * integrand) @ slopes[index].T * _DISTANCE_STEP
    table.flags.writeable = False
    return table


def _quadrature(reach: float) -> tuple[Floats, Floats]:
    """Return the nodes and weights over 0 .. 40, fine enough for phases up to `reach` times the node."""
    edges = np.linspace(0.0, _FADED, 1 + int(np.ceil(_FADED * max(reach, 1.0) / _PANEL_PHASE)))
    nodes, weights = np.polynomial.legendre.leggauss(_PANEL_NODES)
    half = (edges[1] - edges[0]) / 2.0
    return (edges[:-1, None] + half * (nodes + 1.0)).ravel(), np.tile(half * weights, edges.size - 1)


def _spectrum(k: Floats, profile: Profile) -> tuple[Floats, Floats]:
    """Hankel transform of a profile of unit force at radius times spatial frequency, and its slope."""
    small = k < 0.02  # series to k^2, good to 1e-8
    safe = np.where(small, 1.0, k)
    sin, cos = np.sin(safe), np.cos(safe)
    if profile == "flat":
        value, slope = sin / safe, (cos - sin / safe) / safe
        return np.where(small, 1.0 - k**2 / 6.0, value), np.where(small, -k / 3.0, slope)
    value = 3.0 * (sin - safe * cos) / safe**3
    slope = 3.0 * (sin / safe - value) / safe
    return np.where(small, 1.0 - k**2 / 10.0, value), np.where(small, -k / 5.0, slope)


def _bessel(x: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """J_n(x) / x^n for n = 0 .. 3."""
    small = x < 0.3  # series in x^2 / 4; upward recurrence would lose digits
    safe = np.where(small, 1.0, x)
    zero, one = j0(safe), j1(safe) / safe
    two = (2.0 * one - zero) / safe**2
    three = (4.0 * two - one) / safe**2
    h = x**2 / 4.0
    series = [
        (1.0 - h / (n + 1) * (1.0 - h / (2 * (n + 2)) * (1.0 - h / (3 * (n + 3))))) / divisor
        for n, divisor in enumerate((1.0, 2.0, 8.0, 48.0))
    ]
    found = [np.where(small, *both) for both in zip(series, (zero, one, two, three), strict=True)]
    return found[0], found[1], found[2], found[3]
