"""What a rigid plate below a skin adds to the fields of a load, in the spectral domain.

The skin is a layer of thickness h, bonded to a rigid plate. Along the wave vector (l), displacements times 2 mu k
follow from harmonic potentials (Papkovich and Neuber; Barber, Elasticity), with t = k z and derivatives over t:

    u_l = j (phi + t psi),   u_z = phi' + t psi' - (3 - 4 nu) psi

Both potentials are sums of exp(-t), which the half-space has alone, and of exp(t - k h). The correction bears no
traction on the surface, and cancels the half-space's displacement at the plate. All is finite at nu = 1/2.
"""

import math

import numpy as np

from simulators.arrays import Floats

_EXPONENT_MAX = 36.0  # of integrals that decrease as exp(-k (2 h - z))


def layer_profiles(
    distances_m: Floats,
    depth_m: float,
    radii_m: Floats,
    poisson_ratio: float,
    thickness_m: float,
    punch: tuple[float, float],
) -> Floats:
    """Return what to add to `radial_profiles` of radii (k,), shape (k, 5, n); other parameters as there."""
    from scipy.special import j0, j1, jv, spherical_jn  # here: slow to import, and few skins are layers

    half = 0.5 * _EXPONENT_MAX / (2.0 * thickness_m - depth_m)
    nodes, weights = np.polynomial.legendre.leggauss(40 + math.ceil(half * (distances_m.max() + radii_m.max())))
    k = half * (1.0 + nodes)
    measure = half * weights * k
    (pressure_z, stress_z), (pressure_l, stress_l), across = _corrections(k * depth_m, k * thickness_m, poisson_ratio)
    ka = np.maximum(radii_m[:, np.newaxis] * k, 1e-9)
    hertz, flat = 3.0 * spherical_jn(1, ka) / ka, spherical_jn(0, ka)  # spectra of unit loads
    tangential, normal = (measure * (hertz + share * (flat - hertz)) for share in punch)
    x = k[:, np.newaxis] * np.maximum(distances_m, 1e-9)
    bessel_1 = j1(x) / x
    profiles = [
        -(tangential * k * pressure_l) @ bessel_1,
        (tangential * across) @ j0(x) + (tangential * (stress_l - across)) @ bessel_1,
        (tangential * k**2 * (across - stress_l)) @ (jv(2, x) / x**2) / (3.0 * depth_m),
        (normal * pressure_z) @ j0(x),
        (normal * k * stress_z) @ bessel_1 / (3.0 * depth_m),
    ]
    return np.stack(profiles, axis=1)


def _corrections(t: Floats, t_plate: Floats, nu: float) -> tuple[Floats, Floats, Floats]:
    """Return the corrections at depths t of a skin of thickness t_plate, (n,) each.

    They are psi' and stress_lz / j (2, n) under f_z = 1, the same under j f_l = 1, and stress across l under a
    transverse load of -1.
    """
    down, up, far, one = np.exp(-t), np.exp(t - t_plate), np.exp(-t_plate), np.ones_like(t)
    stiff, soft, normal = 3.0 - 4.0 * nu, 1.0 - 2.0 * nu, 2.0 - 2.0 * nu
    of_amplitudes = [  # stress_zz and stress_lz at the surface, u_l and u_z at the plate; of phi, psi down, then up
        [one, -one, far, -far],
        [normal * one, -soft * one, t_plate * far, -(t_plate + stiff) * far],
        [far, far, one, one],
        [-normal * far, -soft * far, t_plate, t_plate - stiff],
    ]
    conditions, found = np.array(of_amplitudes).transpose(2, 1, 0), []
    for phi, psi in ((soft, -1.0), (-normal, 1.0)):  # of the half-space
        displaced = [0.0 * t, 0.0 * t, -far * (phi + t_plate * psi), far * (phi + (t_plate + stiff) * psi)]
        a, b, c, d = np.linalg.solve(conditions, np.array(displaced).T[..., np.newaxis])[..., 0].T
        slope = d * up - b * down
        found.append(np.stack([slope, c * up - a * down + t * slope - soft * (b * down + d * up)]))
    return found[0], found[1], down * (up**2 - far**2) / (1.0 + far**2)  # cosh(t_plate - t)/cosh(t_plate) - exp(-t)
