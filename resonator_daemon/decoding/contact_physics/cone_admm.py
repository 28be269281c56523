"""Least squares under Coulomb's law: f_z >= 0 and |f_t| <= mu f_z in every pixel, by the method of multipliers.

Over-relaxed ADMM (Boyd et al., Foundations and Trends in Machine Learning 3, 2011, section 3.4.3) of
1/2 f' H f - b' f. Given the inverse of H + rho an iteration is one matrix-vector product and one projection.
"""

from collections.abc import Callable

import numpy as np

from resonator_daemon.arrays import Bools, Singles

_RELAXATION = np.float32(1.6)
_TINY = np.float32(1e-30)


def project_on_cone(traction: Singles, friction_coefficient: float) -> Singles:
    """Return the nearest tractions (3, n) in the friction cone."""
    mu = np.float32(friction_coefficient)
    normal = traction[2]
    shear = np.sqrt(traction[0] ** 2 + traction[1] ** 2)
    on_cone = np.maximum((mu * shear + normal) / (1 + mu * mu), 0)
    slips = shear > mu * normal
    projected = np.empty_like(traction)
    scale = np.where(slips, mu * on_cone / (shear + _TINY), 1)
    np.multiply(traction[:2], scale, out=projected[:2])
    projected[2] = np.where(slips, on_cone, normal)
    return projected


def iterate(
    solve_shifted: Callable[[Singles], Singles],
    right_side: Singles,
    rho: float,
    friction_coefficient: float,
    inside: Bools,
    traction: Singles,
    multiplier: Singles,
    iterations: int,
) -> tuple[Singles, Singles]:
    """Go on from a traction in the cone and its scaled multiplier, both (3, n); the new pair.

    Parameters
    ----------
    solve_shifted
        Multiplies (3 n,) by the inverse of H + rho.
    right_side
        b, (3 n,).
    inside
        Pixels that may carry load, (n,); the others are held at 0.
    """
    weight = np.float32(rho)
    keep = inside.astype(np.float32)
    for _ in range(iterations):
        free = solve_shifted(right_side + weight * (traction - multiplier).ravel()).reshape(traction.shape)
        free *= _RELAXATION
        free += multiplier - (_RELAXATION - 1) * traction
        traction = project_on_cone(free, friction_coefficient) * keep
        multiplier = free - traction
    return traction, multiplier
