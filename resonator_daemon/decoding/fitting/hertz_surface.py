"""What a load with the profile of a Hertz pressure makes of the surface that it acts on: closed forms."""

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.elastic import HalfSpace


def hertz_traction(distance_m: Floats, radius_m: Floats | float) -> Floats:
    """3 / (2 pi a^2) sqrt(1 - r^2 / a^2), in Pa per newton; 0 outside of the disc."""
    height = np.sqrt(np.maximum(1.0 - (distance_m / radius_m) ** 2, 0.0))
    return np.asarray(1.5 / (np.pi * np.square(radius_m)) * height, np.float64)


def hertz_displacement(half_space: HalfSpace, offset_m: Floats, radius_m: float) -> Floats:
    """Displacement of the surface at offsets (n, 2) from the centre of a disc of radius a, in metres per newton.

    Johnson, Contact Mechanics, 1985: equations (3.41) to (3.43) for a force along z, (3.91) and (3.92) for one along x;
    what the latter does along z follows by reciprocity.

    Returns
    -------
    Shape (force x, y, z; displacement x, y, z; n).
    """
    nu, a = half_space.poisson_ratio, radius_m
    x, y = offset_m.T
    r = np.hypot(x, y)
    sine = a / np.maximum(r, a)  # 1 within the disc
    angle, cosine = np.arcsin(sine), np.sqrt(1.0 - sine**2)
    even = (2.0 * a**2 - r**2) * angle + a * r * cosine
    turning = r**2 * angle + (2.0 * a**2 - r**2) * sine * cosine
    squared = np.where(r > 0.0, r, 1.0) ** 2
    inward = (1.0 - 2.0 * nu) / 6.0 * a**2 * (1.0 - np.maximum(1.0 - (r / a) ** 2, 0.0) ** 1.5) / squared
    along = turning * nu / 16.0 * (x**2 - y**2) / squared
    found = np.empty((3, 3, r.size))
    found[0, 0], found[1, 1] = (2.0 - nu) / 8.0 * even + along, (2.0 - nu) / 8.0 * even - along
    found[0, 1] = found[1, 0] = turning * nu / 8.0 * x * y / squared
    found[2, 2] = (1.0 - nu) / 4.0 * even
    found[0, 2], found[1, 2] = inward * a * x, inward * a * y
    found[2, 0], found[2, 1] = -found[0, 2], -found[1, 2]
    return found * (1.5 / (np.pi * a**3 * half_space.shear_modulus_pascal))
