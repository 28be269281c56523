"""Signals inside an elastic half-space under Hertz-distributed surface loads, from the point solutions.

Surface load f (x, y, z; f_z > 0 presses into the body), z into the body, stress positive in tension. With
phi = 1/rho, rho the distance from the point of load, the fields of Boussinesq (normal) and Cerruti (tangential) give

    p_n      =  (1 + nu)/(3 pi)  f . grad phi
    sigma_iz = -1/(2 pi)         (z d_i d_j phi - delta_ij d_z phi) f_j,       i = x, y

(Johnson, Contact Mechanics, 1985, sections 3.2 and 3.6: with phi inserted, sigma_iz = -3 z x_i (x . f)/(2 pi rho^5)
and p_n = -(1 + nu) (x . f)/(3 pi rho^3)). Both are linear in phi: a distributed load only needs its own potential.

A Hertz distribution 3/(2 pi a^2) sqrt(1 - r^2/a^2) has the potential of point sources strung along an imaginary
depth (Green and Collins; Barber, Elasticity, on axisymmetric contact):

    phi = Re integral_0^1 (3/2)(1 - s^2) / sqrt(r^2 + (z + i a s)^2) ds

Its integrand is smooth below the surface, where an integral over the disc would meet the square-root edge. With 1 in
place of (3/2)(1 - s^2), the load is that of a flat punch, 1/(2 pi a^2) / sqrt(1 - r^2/a^2).
"""

import functools
import math

import numpy as np
import numpy.typing as npt

from simulators.arrays import Floats


def hertz_fields(
    offsets_m: npt.ArrayLike,
    depth_m: float,
    radii_m: npt.ArrayLike,
    youngs_modulus_pascal: float,
    poisson_ratio: float,
) -> Floats:
    """Signals per newton under Hertz-distributed loads of several radii.

    Parameters
    ----------
    offsets_m
        Places where the signals are sensed, relative to the centre of the load, shape (n, 2).
    depth_m
        Their depth below the surface.
    radii_m
        Radii of the loads, shape (k,); 0 is a point load.
    youngs_modulus_pascal, poisson_ratio
        Of the half-space; a ratio of 0.5 is exact.

    Returns
    -------
    Array of shape (k, 3, 3, n): radius, direction of the force (x, y, z), signal (p_n in pascals, tensor shear
    strains eps_xz and eps_yz), place.
    """
    offsets, radii = np.asarray(offsets_m, dtype=np.float64), np.asarray(radii_m, dtype=np.float64)
    _check(offsets, depth_m, radii, youngs_modulus_pascal, poisson_ratio)
    x, y = offsets.T
    z = depth_m
    fields = np.empty((len(radii), 3, 3, len(x)))
    for (p_n, eps_xz, eps_yz), radius in zip(fields.swapaxes(1, 2), radii, strict=True):
        over_3, over_3_depth, over_5, over_5_depth = potential_integrals(x**2 + y**2, z, float(radius))
        p_n[:] = -x * over_3, -y * over_3, -over_3_depth
        across = 3.0 * z * x * y * over_5
        isotropic = over_3_depth - z * over_3
        eps_xz[:] = 3.0 * z * x**2 * over_5 + isotropic, across, 3.0 * z * x * over_5_depth
        eps_yz[:] = across, 3.0 * z * y**2 * over_5 + isotropic, 3.0 * z * y * over_5_depth
    pressure_factor, strain_factor = signal_factors(youngs_modulus_pascal, poisson_ratio)
    fields[:, :, 0] *= pressure_factor
    fields[:, :, 1:] *= strain_factor
    return fields


def signal_factors(youngs_modulus_pascal: float, poisson_ratio: float) -> tuple[float, float]:
    """Return what the derivatives of the potential are multiplied by: of p_n (no unit), and of strains (1/Pa)."""
    pressure_factor = (1.0 + poisson_ratio) / (3.0 * math.pi)
    return pressure_factor, -(1.0 + poisson_ratio) / (2.0 * math.pi * youngs_modulus_pascal)  # eps = sigma (1 + nu)/E


def _check(
    offsets_m: Floats, depth_m: float, radii_m: Floats, youngs_modulus_pascal: float, poisson_ratio: float
) -> None:
    if offsets_m.ndim != 2 or offsets_m.shape[1] != 2:
        raise ValueError(f"offsets_m has shape {offsets_m.shape}, must be (n, 2)")
    if not depth_m > 0.0:
        raise ValueError(f"depth_m is {depth_m}, must be above 0: the fields are those below the surface")
    if radii_m.ndim != 1 or not np.all(radii_m >= 0.0):
        raise ValueError(f"radii_m is {radii_m}, must be one-dimensional and at least 0")
    if not youngs_modulus_pascal > 0.0:
        raise ValueError(f"youngs_modulus_pascal is {youngs_modulus_pascal}, must be above 0")
    if not -1.0 < poisson_ratio <= 0.5:
        raise ValueError(f"poisson_ratio is {poisson_ratio}, must be above -1 and at most 0.5")


def radial_profiles(distances_m: Floats, depth_m: float, radius_m: float, punch: tuple[float, float]) -> Floats:
    """Return the derivatives of the potential that make the signals at distances (n,), as functions of them alone.

    Parameters
    ----------
    distances_m, depth_m
        Places, relative to the centre of the load.
    radius_m
        Radius of the load.
    punch
        Shares of a flat punch's distribution in tangential and in normal loads; the rest is Hertz's.

    Returns
    -------
    Profiles (5, n), with tangential load along d: those of p_n (times d x), of strains along d and of strains along x
    (times d x); then, with normal load, those of p_n and of strains along x. Strains along x have a factor 3 z.
    """
    shear, normal = (potential_integrals(distances_m**2, depth_m, radius_m, share) for share in punch)
    return np.stack([shear[0], shear[1] - depth_m * shear[0], shear[2], normal[1], normal[3]])


def potential_integrals(
    distance_squared_m2: Floats, depth_m: float, radius_m: float, punch: float = 0.0
) -> tuple[Floats, Floats, Floats, Floats]:
    """Integrals of 1/R^3, Z/R^3, 1/R^5, Z/R^5 over complex depths Z = z + i a s, where R^2 = r^2 + Z^2, each (n,).

    Of the load, the share `punch` is distributed as by a flat punch, the rest as by Hertz.
    """
    # The integrand's singularities lie at s = (+-r + i z)/a, so Gauss-Legendre on (-1, 1) converges like exp(-2 m q)
    # or faster, sinh q = z/a. The negative half of the rule repeats the positive one conjugated: only that is summed.
    order = 2 * math.ceil(8.0 / math.asinh(depth_m / radius_m)) + 8 if radius_m > 0.0 else 4
    nodes, weights = (half[order // 2 :] for half in _gauss_legendre(order))
    weights = (punch + (1.0 - punch) * 1.5 * (1.0 - nodes**2)) * weights
    depths = depth_m + 1j * radius_m * nodes
    over_2 = 1.0 / (distance_squared_m2 + (depths**2)[:, np.newaxis])
    over_3 = over_2 * np.sqrt(over_2)
    over_5 = over_3 * over_2
    rules = np.stack([weights, weights * depths])
    (third, third_depth), (fifth, fifth_depth) = (rules @ over_3).real, (rules @ over_5).real
    return third, third_depth, fifth, fifth_depth


@functools.cache
def _gauss_legendre(order: int) -> tuple[Floats, Floats]:
    nodes, weights = np.polynomial.legendre.leggauss(order)
    return nodes, weights
