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
from scipy.interpolate import CubicSpline

from simulators.arrays import Floats
from simulators.half_space_fields import hertz_fields

_KNOTS_PER_DEPTH = 10  # of the table over radii: the fields change over radii of about the depth


def contact_radius_m(normal_force_newton: npt.ArrayLike, radius_m_at_1_newton: float) -> Floats:
    """Radius of contact, growing with the cube root of force; 0 where nothing presses."""
    return radius_m_at_1_newton * np.cbrt(np.maximum(normal_force_newton, 0.0))


def hertz_parts(
    force_newton: npt.ArrayLike, radius_m_at_1_newton: float, friction_coefficient: float
) -> tuple[Floats, Floats]:
    """Split a contact's load into two Hertz distributions: all of the disc, and the part that sticks.

    Parameters
    ----------
    force_newton
        Force x, y, z, shape (..., 3). Shear beyond friction is clipped to full sliding; where force z <= 0, nothing
        acts.
    radius_m_at_1_newton
        Radius of contact at a force of 1 N.
    friction_coefficient
        Of Coulomb's law, at least 0.

    Returns
    -------
    radii_m
        Contact radius a and stick radius c = a (1 - F_t/(mu F_z))^(1/3), shape (..., 2).
    forces_newton
        Force carried by the distribution of each radius, shape (..., 2, 3); their sum is the force that acts.
    """
    if not radius_m_at_1_newton > 0.0:
        raise ValueError(f"radius_m_at_1_newton is {radius_m_at_1_newton}, must be above 0")
    if not friction_coefficient >= 0.0:
        raise ValueError(f"friction_coefficient is {friction_coefficient}, must be at least 0")
    force = np.asarray(force_newton, dtype=np.float64)
    if force.shape[-1:] != (3,):
        raise ValueError(f"force_newton has shape {force.shape}, must be (..., 3)")
    normal = np.maximum(force[..., 2], 0.0)
    sliding = friction_coefficient * normal
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


class PressedSpot:
    """Signals at fixed places below one contact, quick enough to be asked for in every frame.

    The fields of a Hertz distribution depend on its radius alone; they are computed once over a range of radii, then
    interpolated by a cubic spline. A part's force scales them.
    """

    def __init__(
        self,
        positions_m: npt.ArrayLike,
        depth_m: float,
        youngs_modulus_pascal: float,
        poisson_ratio: float,
        centre_m: tuple[float, float],
        radius_m_at_1_newton: float,
        friction_coefficient: float,
        force_max_newton: float,
    ) -> None:
        """Tabulate the fields at `positions_m` (n, 2), all at `depth_m`, for normal forces up to `force_max_newton`."""
        if not force_max_newton > 0.0:
            raise ValueError(f"force_max_newton is {force_max_newton}, must be above 0")
        if not depth_m > 0.0:
            raise ValueError(f"depth_m is {depth_m}, must be above 0: the fields are those below the surface")
        self._radius_m_at_1_newton = radius_m_at_1_newton
        self._friction_coefficient = friction_coefficient
        self._force_max_newton = force_max_newton
        radius_max_m = float(
            hertz_parts((0.0, 0.0, force_max_newton), radius_m_at_1_newton, friction_coefficient)[0][0]
        )
        radii = np.linspace(0.0, radius_max_m, 4 + math.ceil(_KNOTS_PER_DEPTH * radius_max_m / depth_m))
        offsets = np.asarray(positions_m, dtype=np.float64) - np.asarray(centre_m)
        fields = hertz_fields(offsets, depth_m, radii, youngs_modulus_pascal, poisson_ratio)
        # The fields are even in the radius, hence the slope of 0 at its lower end. Per knot: value and slope, so that
        # two neighbours hold all that one interval needs.
        spline = CubicSpline(radii, fields, bc_type=("clamped", "not-a-knot"))
        self._knot_spacing_m = float(radii[1])
        self._table = np.stack([fields, spline(radii, 1) * self._knot_spacing_m], axis=1)

    def signals(self, force_newton: npt.ArrayLike) -> Floats:
        """Signals [p_n (Pa), eps_xz, eps_yz] under forces x, y, z: (3,) -> (3, n), (t, 3) -> (t, 3, n).

        Forces are taken as by `hertz_parts`. ValueError where one is not finite or presses beyond the table.
        """
        force = np.asarray(force_newton, dtype=np.float64)
        if not np.all(np.isfinite(force)):
            raise ValueError(f"force_newton is {force}, must be finite")
        radii, parts = hertz_parts(force, self._radius_m_at_1_newton, self._friction_coefficient)
        if np.any(force[..., 2] > self._force_max_newton):
            raise ValueError(f"force z is {force[..., 2].max()} N, tabulated up to {self._force_max_newton} N")
        place = radii / self._knot_spacing_m
        knots = np.minimum(place.astype(np.intp), len(self._table) - 2)
        weights = _hermite_weights(place - knots)[..., np.newaxis] * parts[..., np.newaxis, :]
        signals = np.zeros((*force.shape[:-1], 3, self._table.shape[-1]))
        for frame in np.ndindex(force.shape[:-1]):
            row = signals[frame].reshape(-1)
            for knot, weight in zip(knots[frame], weights[frame], strict=True):
                row += weight.reshape(-1) @ self._table[knot : knot + 2].reshape(12, -1)
        return signals


def _hermite_weights(fraction: Floats) -> Floats:
    """Cubic Hermite weights (..., 4) of value and slope at the lower, then at the upper end of a unit interval."""
    rest = 1.0 - fraction
    return np.stack(
        [
            rest**2 * (1.0 + 2.0 * fraction),
            rest**2 * fraction,
            fraction**2 * (1.0 + 2.0 * rest),
            -(fraction**2) * rest,
        ],
        axis=-1,
    )
