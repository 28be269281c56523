"""Coulomb's law of friction in every pixel: f_z >= 0 and |f_t| <= mu f_z."""

import numpy as np

from resonator_daemon.base.arrays import Singles

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
