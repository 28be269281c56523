"""Signals below contacts at any place, in every frame: fields of round loads, tabulated and superposed.

The fields of a round load have five profiles (`half_space_fields`), which depend on distance and radius alone. A table
over both thus serves every place. Between knots it is interpolated by cubic polynomials, with the slopes of a spline.
Contacts add up, and so do the two Hertz loads of partial slip.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from simulators.arrays import Floats
from simulators.bonded_layer import layer_profiles
from simulators.half_space_fields import radial_profiles, signal_factors

_KNOTS_PER_DEPTH = 10  # in distance and radius: the fields change over about the depth
_PLACES_KEPT = 64  # of contacts that stay where they are


class _Below(NamedTuple):
    """Sites as a contact at one place has them."""

    offset_m: Floats  # (2, n), x and y from the contact
    interpolation: csr_array  # (n, 2 d): values and slopes at d distances to values at the sites


class PressedSurface:
    """Signals of sites at one depth below contacts on the surface."""

    def __init__(
        self,
        positions_m: npt.ArrayLike,
        depth_m: float,
        youngs_modulus_pascal: float,
        poisson_ratio: float,
        distance_max_m: float,
        radius_max_m: float,
        *,
        punch: tuple[float, float] = (0.0, 0.0),
        thickness_m: float = math.inf,
    ) -> None:
        """Tabulate fields for sites (n, 2) that are at most so far from a contact, which is at most so large.

        `punch` is as of `radial_profiles`; the body is a layer of this thickness on a rigid base, or a half-space.
        """
        self._positions_m = np.asarray(positions_m, dtype=np.float64)
        self._depth_m = depth_m
        self._pressure_factor, self._strain_factor = signal_factors(youngs_modulus_pascal, poisson_ratio)
        distances_m, radii_m = _knots(distance_max_m, depth_m), _knots(radius_max_m, depth_m)
        self._spacing_m = float(distances_m[1]), float(radii_m[1])
        self._ends_m = distance_max_m, radius_max_m
        # All profiles are even in distance and radius, hence slopes of 0 at the lower ends.
        values = np.stack([radial_profiles(distances_m, depth_m, float(radius), punch) for radius in radii_m])
        if math.isfinite(thickness_m):
            values += layer_profiles(distances_m, depth_m, radii_m, poisson_ratio, thickness_m, punch)
        by_distance = _spline_slopes(distances_m, values.transpose(2, 0, 1)).transpose(1, 2, 0)
        fields = np.concatenate([values, by_distance * self._spacing_m[0]], axis=-1)
        # Radius, value and slope over it, profile, values and then slopes over distance.
        self._table = np.stack([fields, _spline_slopes(radii_m, fields) * self._spacing_m[1]], axis=1)
        self._below = lru_cache(_PLACES_KEPT)(self._seen_from)

    def signals(self, centre_m: tuple[float, float], radii_m: Floats, forces_newton: Floats) -> Floats:
        """Return the signals of the sites below one contact at m moments.

        Parameters
        ----------
        centre_m
            Its centre.
        radii_m, forces_newton
            Of the Hertz loads that it consists of, (m, p) and (m, p, 3), as from `hertz_parts`.

        Returns
        -------
        p_n in pascals, eps_xz and eps_yz, shape (m, 3, n).

        Raises
        ------
        ValueError
            A radius or a distance beyond the table.
        """
        if not radii_m.max() <= self._ends_m[1] * (1.0 + 1e-9):
            raise ValueError(f"radius {radii_m.max():g} m, tabulated up to {self._ends_m[1]:g} m")
        (x, y), interpolation = self._below(centre_m)
        shear_newton, z = forces_newton[..., :2].sum(axis=1), self._depth_m
        size_newton = np.hypot(*shear_newton.T)[:, np.newaxis]
        along = np.divide(shear_newton, size_newton, out=np.full_like(shear_newton, [1.0, 0.0]), where=size_newton > 0)
        shears_newton = (forces_newton[..., :2] * along[:, np.newaxis]).sum(axis=2)  # all have the same direction
        of_unit = self._profiles(radii_m.ravel()).reshape(*radii_m.shape, 5, -1)
        profiles = np.concatenate(
            [_loaded(shears_newton, of_unit[:, :, :3]), _loaded(forces_newton[..., 2], of_unit[:, :, 3:])]
        )
        at_sites = np.ascontiguousarray((interpolation @ profiles.reshape(-1, profiles.shape[-1]).T).T)
        shear_3, isotropic, shear_5, normal_3, normal_5 = at_sites.reshape(5, len(along), -1)
        along_x, along_y = along.T[..., np.newaxis]
        distance_along = along_x * x + along_y * y
        outward = 3.0 * z * (distance_along * shear_5 + normal_5)
        signals = np.empty((len(along), 3, len(x)))
        signals[:, 0] = -self._pressure_factor * (distance_along * shear_3 + normal_3)
        signals[:, 1] = self._strain_factor * (x * outward + along_x * isotropic)
        signals[:, 2] = self._strain_factor * (y * outward + along_y * isotropic)
        return signals

    def _profiles(self, radii_m: Floats) -> Floats:
        """Return the profiles (p, 5, 2 d) of unit loads of these radii: values at d distances, then slopes."""
        place = radii_m / self._spacing_m[1]
        knot = np.minimum(place.astype(np.intp), len(self._table) - 2)
        weights = _hermite_weights(place - knot)
        near = self._table[knot[:, np.newaxis] + np.arange(2)].reshape(len(knot), 4, -1)
        interpolated: Floats = (weights.T[:, np.newaxis] @ near).reshape(-1, *self._table.shape[2:])
        return interpolated

    def _seen_from(self, centre_m: tuple[float, float]) -> _Below:
        offset_m = np.ascontiguousarray((self._positions_m - np.asarray(centre_m)).T)
        distance_m = np.hypot(*offset_m)
        if not distance_m.max() <= self._ends_m[0] * (1.0 + 1e-9):
            raise ValueError(f"a site is {distance_m.max():g} m away, tabulated up to {self._ends_m[0]:g} m")
        place = distance_m / self._spacing_m[0]
        knots = self._table.shape[-1] // 2
        knot = np.minimum(place.astype(np.intp), knots - 2)
        columns = np.stack([knot, knots + knot, knot + 1, knots + knot + 1], axis=1)
        weights, rows = _hermite_weights(place - knot).T, np.arange(len(knot) + 1) * 4
        return _Below(offset_m, csr_array((weights.ravel(), columns.ravel(), rows), shape=(len(knot), 2 * knots)))


def _loaded(forces_newton: Floats, of_unit: Floats) -> Floats:
    """Return profiles (q, m, 2 d) of m moments, each a sum of p loads (m, p) with profiles (m, p, q, 2 d)."""
    moments, parts, profiles, _ = of_unit.shape
    summed: Floats = forces_newton[:, np.newaxis] @ of_unit.reshape(moments, parts, -1)
    return summed.reshape(moments, profiles, -1).swapaxes(0, 1)


def _knots(end_m: float, depth_m: float) -> Floats:
    return np.linspace(0.0, end_m, 4 + math.ceil(_KNOTS_PER_DEPTH * end_m / depth_m))


def _spline_slopes(knots: Floats, values: Floats) -> Floats:
    """Return the slopes (n, ...) of a cubic spline at its knots, 0 at the first; the last knot but one is none.

    The tridiagonal system of its continuous curvature; scipy.interpolate takes most of a second to import.
    """
    step = np.diff(knots).reshape(-1, *[1] * (values.ndim - 1))
    secant, last = np.diff(values, axis=0) / step, float(knots[-1] - knots[-3])
    below = np.append(step.ravel()[1:], last)
    above = np.insert(step.ravel()[:-1], 0, 0.0)
    diagonal = np.concatenate([[1.0], 2.0 * (step[:-1] + step[1:]).ravel(), step[-2].ravel()])
    slopes = np.zeros_like(values)
    slopes[1:-1] = 3.0 * (step[1:] * secant[:-1] + step[:-1] * secant[1:])
    slopes[-1] = (step[-1] ** 2 * secant[-2] + (2.0 * last + step[-1]) * step[-2] * secant[-1]) / last
    for row in range(len(below)):
        share = below[row] / diagonal[row]
        diagonal[row + 1] -= share * above[row]
        slopes[row + 1] -= share * slopes[row]
    slopes[-1] /= diagonal[-1]
    for row in reversed(range(len(above))):
        slopes[row] = (slopes[row] - above[row] * slopes[row + 1]) / diagonal[row]
    return slopes


def _hermite_weights(fraction: Floats) -> Floats:
    """Cubic Hermite weights (4, n) of value and slope at the lower, then at the upper end of a unit interval."""
    rest = 1.0 - fraction
    return np.stack(
        [
            rest**2 * (1.0 + 2.0 * fraction),
            rest**2 * fraction,
            fraction**2 * (1.0 + 2.0 * rest),
            -(fraction**2) * rest,
        ]
    )
