"""Partial-slip contact of a paraboloid (Cattaneo-Mindlin): its tractions on the surface, its signals below.

The contact disc carries a Hertz pressure; its shear traction is that of full sliding less a smaller Hertz
distribution over the disc that still sticks. Every load here is thus a sum of two Hertz distributions of equal centre
(Johnson, Contact Mechanics, 1985, sections 4.2 and 7.2; Cattaneo 1938; Mindlin 1949). As usual, the contact radius is
taken as independent of shear, and the slip direction as that of the tangential force.

Convention: force and traction act on the body, z into it; f_z > 0 presses.
"""

import math

import numpy as np
import numpy.typing as npt

from simulators.arrays import Floats
from simulators.half_space_fields import hertz_fields


def contact_radius_m(normal_force_newton: npt.ArrayLike, radius_m_at_1_newton: npt.ArrayLike) -> Floats:
    """Radius of contact, growing with the cube root of force; 0 where nothing presses."""
    radius: Floats = np.asarray(radius_m_at_1_newton) * np.cbrt(np.maximum(normal_force_newton, 0.0))
    return radius


def hertz_parts(
    force_newton: npt.ArrayLike, radius_m_at_1_newton: npt.ArrayLike, friction_coefficient: npt.ArrayLike
) -> tuple[Floats, Floats]:
    """Split a contact's load into two Hertz distributions: all of the disc, and the part that sticks.

    Parameters
    ----------
    force_newton
        Force x, y, z, shape (..., 3). Shear beyond friction is clipped to full sliding; where force z <= 0, nothing
        acts.
    radius_m_at_1_newton
        Radius of contact at a force of 1 N, one or for each force (...).
    friction_coefficient
        Of Coulomb's law, at least 0, likewise.

    Returns
    -------
    radii_m
        Contact radius a and stick radius c = a (1 - F_t/(mu F_z))^(1/3), shape (..., 2).
    forces_newton
        Force carried by the distribution of each radius, shape (..., 2, 3); their sum is the force that acts.
    """
    if not np.all(np.asarray(radius_m_at_1_newton) > 0.0):
        raise ValueError(f"radius_m_at_1_newton is {radius_m_at_1_newton!r}, must be above 0")
    friction = np.asarray(friction_coefficient, dtype=np.float64)
    if not np.all(friction >= 0.0):
        raise ValueError(f"friction_coefficient is {friction_coefficient!r}, must be at least 0")
    force = np.asarray(force_newton, dtype=np.float64)
    if force.shape[-1:] != (3,):
        raise ValueError(f"force_newton has shape {force.shape}, must be (..., 3)")
    normal = np.maximum(force[..., 2], 0.0)
    sliding = friction * normal
    shear = np.hypot(force[..., 0], force[..., 1])
    held = np.maximum(sliding - shear, 0.0)  # what friction could carry in addition
    stick_ratio = np.cbrt(np.divide(held, sliding, out=np.zeros_like(held), where=sliding > 0.0))
    direction = force[..., :2] / np.where(shear > 0.0, shear, 1.0)[..., np.newaxis]
    radius = contact_radius_m(normal, radius_m_at_1_newton)
    forces = np.zeros((*force.shape[:-1], 2, 3))
    forces[..., 0, :2] = sliding[..., np.newaxis] * direction
    forces[..., 0, 2] = normal
    forces[..., 1, :2] = -held[..., np.newaxis] * direction
    return np.stack([radius, radius * stick_ratio], axis=-1), forces


def punch_parts(
    force_newton: npt.ArrayLike, radius_m_at_1_newton: npt.ArrayLike, friction_coefficient: npt.ArrayLike
) -> tuple[Floats, Floats]:
    """Return radii and forces, as `hertz_parts`, of a flat punch as wide as a ball's contact; the second force is zero.

    Its shear traction is everywhere the same share of its pressure (Ciavarella 1998): all of it sticks or slides.
    """
    radii, forces = hertz_parts(force_newton, radius_m_at_1_newton, friction_coefficient)
    sticks = radii[..., 1] > 0.0
    radii[..., 1] = np.where(sticks, radii[..., 0], 0.0)
    forces[..., 0, :] += forces[..., 1, :]
    forces[..., 1, :] = 0.0
    return radii, forces


def pixel_tractions(
    force_newton: npt.ArrayLike,
    centre_m: tuple[float, float],
    radius_m_at_1_newton: float,
    friction_coefficient: float,
    shape: tuple[int, int],
    pitch_m: float,
) -> Floats:
    """Traction averaged over the square pixels of a grid whose centre is the origin.

    Parameters
    ----------
    force_newton
        Force x, y, z, shape (3,), taken as by `hertz_parts`.
    centre_m
        Centre of contact (x, y); what lies off the grid is left out, so that the resultant over the pixels is the
        force where the whole disc lies on it.
    radius_m_at_1_newton, friction_coefficient
        As of `hertz_parts`.
    shape
        Rows along y, columns along x.
    pitch_m
        Side of a pixel.

    Returns
    -------
    Traction x, y, z in pascals, shape (3, ny, nx).
    """
    if not pitch_m > 0.0:
        raise ValueError(f"pitch_m is {pitch_m}, must be above 0")
    rows, columns = shape
    edges_x = (np.arange(columns + 1) - columns / 2) * pitch_m - centre_m[0]
    edges_y = (np.arange(rows + 1) - rows / 2) * pitch_m - centre_m[1]
    traction = np.zeros((3, rows, columns))
    radii, forces = hertz_parts(force_newton, radius_m_at_1_newton, friction_coefficient)
    for radius, force in zip(radii, forces, strict=True):
        if radius > 0.0:
            share = np.diff(np.diff(_share_up_to(edges_x / radius, edges_y[:, np.newaxis] / radius), axis=0), axis=1)
            traction += force[:, np.newaxis, np.newaxis] * share / pitch_m**2
    return traction


def point_tractions(
    force_newton: npt.ArrayLike,
    centre_m: tuple[float, float],
    radius_m_at_1_newton: float,
    friction_coefficient: float,
    positions_m: npt.ArrayLike,
) -> Floats:
    """Traction x, y, z in pascals, (3, n), at places (n, 2) on the surface; the other parameters as `hertz_parts`."""
    distances = np.linalg.norm(np.asarray(positions_m, dtype=np.float64) - np.asarray(centre_m), axis=-1)
    traction = np.zeros((3, len(distances)))
    radii, forces = hertz_parts(force_newton, radius_m_at_1_newton, friction_coefficient)
    for radius, force in zip(radii, forces, strict=True):
        if radius > 0.0:
            height = np.sqrt(np.maximum(1.0 - (distances / radius) ** 2, 0.0))
            traction += 1.5 / (math.pi * radius**2) * force[:, np.newaxis] * height
    return traction


def _share_up_to(x: Floats, y: Floats) -> Floats:
    """Integral of the unit-force Hertz distribution of radius 1 over the rectangle from 0 to (x, y); odd in both.

    It is the volume of a ball above a rectangle in its equatorial plane, over that of the half ball. Where the corner
    lies off the disc, its height 0 turns the arcus tangents into right angles and the volume into a sum of caps.
    """
    x, y = np.clip(x, -1.0, 1.0), np.clip(y, -1.0, 1.0)
    height = np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))
    volume = (
        2.0 * x * y * height
        + x * (3.0 - x**2) * np.arctan2(y, height)
        + y * (3.0 - y**2) * np.arctan2(x, height)
        - 2.0 * np.arctan2(x * y, height)
    ) / 6.0
    share: Floats = volume * 3.0 / (2.0 * math.pi)
    return share


def pressed_signals(
    positions_m: npt.ArrayLike,
    depth_m: float,
    youngs_modulus_pascal: float,
    poisson_ratio: float,
    centre_m: tuple[float, float],
    radius_m_at_1_newton: float,
    friction_coefficient: float,
    force_newton: npt.ArrayLike,
) -> Floats:
    """Return the signals [p_n (Pa), eps_xz, eps_yz], (3, n), at places (n, 2) below a contact, without a table.

    The force (3,) is taken as by `hertz_parts`.
    """
    radii, parts = hertz_parts(force_newton, radius_m_at_1_newton, friction_coefficient)
    offsets = np.asarray(positions_m, dtype=np.float64) - np.asarray(centre_m)
    fields = hertz_fields(offsets, depth_m, radii, youngs_modulus_pascal, poisson_ratio)
    signals: Floats = np.einsum("pi,pisn->sn", parts, fields)
    return signals
