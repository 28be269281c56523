"""Signals of contacts in partial slip and their slopes, from tables over distance, in single precision: fast.

In units of the depth z, with d = (site - centre) / z, r = |d| and s = d . F, a force F spread over a disc makes

    p = s A + F_z P,    eps = d (F_z E + 2 C s) + (F_x, F_y) D,    D = B - r^2 C,

where A, C, D, P, E depend on r and on the radius alone. A contact in partial slip has the shear parts
(1 + e) h_a - e h_c of two discs, e = m / (1 - m), so that the two are combined over distance first and then taken to
the sites. Values are extrapolated from the nearest knot by their slope, with errors of about 1e-5; slopes are those of
the nearest knot, with errors below 1 % that alternate from site to site.
"""

from functools import lru_cache

import numpy as np

from resonator_daemon.base.arrays import Floats, Indices, Singles

PARAMETERS = 7  # of a contact
X, Y, RADIUS, FORCE_X, FORCE_Y, FORCE_Z, MARGIN = range(PARAMETERS)
_KNOTS = 501  # even in r^2 / (r^2 + 7)
_HALF_WAY = 7.0  # squared depths, at half of the knots
_NEARLY_STUCK = 0.97  # margin from which both discs are interpolated between the same radii: else m has no digits
ROWS = 8  # of a contact: its signals, and their slopes by a, m, x, y, F_x, F_y, F_z
_SLOPES = np.array([3, 4, 1, 5, 6, 7, 2])  # rows of the slopes by the parameters in their usual order


class SlipSignals:
    """Signals [3 p_n / (2 E), eps_xz, eps_yz] of contacts in partial slip, and their slopes.

    Parameters
    ----------
    sites_m
        (n, 2).
    depth_m
        Of all sites.
    knots
        Distances in depths, as of `distance_knots`.
    value, slope
        Integrals pressed, along for p, along for strain, sheared and turned at the knots, and (1/r) d/dr of them:
        (radii; value, slope by radius times the step; 5; knots).
    radius_step
        Between radii, in depths.
    """

    def __init__(
        self, sites_m: Floats, depth_m: float, knots: Floats, value: Floats, slope: Floats, radius_step: float
    ) -> None:
        self._count = len(sites_m)
        self._per_area = depth_m**-2
        self._depth_m = depth_m
        self._sites = np.ascontiguousarray(sites_m.T / depth_m, np.float32)  # (2, n), in depths
        self._radius_step = radius_step
        squares = knots**2
        self._knots_per_share = (_KNOTS - 1) * float(1.0 + _HALF_WAY / squares[-1])
        self._half_squares = (0.5 * squares).astype(np.float32)
        pressed, along_p, along_eps, sheared, turned = np.moveaxis(value, 2, 0)
        of_pressed, of_along_p, of_along_eps, of_sheared, of_turned = np.moveaxis(slope, 2, 0)
        straight = sheared - squares * turned
        of_straight = of_sheared - 2.0 * turned - squares * of_turned
        rows = [along_p, 2.0 * turned, straight, of_along_p, 2.0 * of_turned, of_straight]
        rows += [pressed, along_eps, of_pressed, of_along_eps]
        self._table = np.stack(rows, axis=2).astype(np.float32).reshape(2 * len(value), 10 * _KNOTS)

    def whiten(self, weights: Floats) -> Singles:
        """Return what `fill` multiplies by, for signals that are to be multiplied by weights (3 n,)."""
        return np.asarray(weights.reshape(3, -1) * self._per_area, np.float32).ravel()

    def fill(self, contact: Floats, whiten: Singles, rows: Singles) -> Floats:
        """Write signals and slopes of a contact, (8, 3 n); returns by what to multiply each slope, (7,).

        Slopes by the parameters, in their order, are the rows `slope_rows(1)`, each times its factor.
        """
        x_m, y_m, radius_m, force_x, force_y, force_z, margin = contact.tolist()
        force = np.array([[force_x], [force_y]], np.float32)
        centre = np.array([[x_m / self._depth_m], [y_m / self._depth_m]], np.float32)
        profiles = self._profiles(radius_m / self._depth_m, margin, force_z)
        self._write(self._sites - centre, profiles, force, rows.reshape(ROWS, 3, self._count))
        rows *= whiten
        per_m = 1.0 / self._depth_m
        return np.array([-per_m, -per_m, per_m, 1.0, 1.0, 1.0 / force_z, 1.0])

    def _profiles(self, radius: float, margin: float, force_z: float) -> Singles:
        """Return the functions of distance at a radius in depths, (5, 4, knots).

        A, 2 C, D, F_z P, F_z E, each itself, by a, by m and (1/r) d/dr.
        """
        ratio = margin ** (1.0 / 3.0)
        rest = 1.0 / (1.0 - margin)
        excess, change = margin * rest, rest * rest  # e, and its slope by m
        last = len(self._table) // 2 - 2
        knot = min(int(radius / self._radius_step), last)
        stuck_knot = knot if margin > _NEARLY_STUCK else min(int(ratio * radius / self._radius_step), last)
        whole, by_whole = self._hermite(radius, knot)
        stuck, by_stuck = self._hermite(ratio * radius, stuck_knot)
        # Of values and slopes at two radii: the functions, by the radius, by the margin
        shear = np.array(
            [[(1.0 + excess) * w for w in whole], [(1.0 + excess) * w for w in by_whole], [change * w for w in whole]]
        )
        held = np.array(
            [
                [excess * w for w in stuck],
                [excess * ratio * w for w in by_stuck],
                [change * w + radius * ratio * rest / 3.0 * s for w, s in zip(stuck, by_stuck, strict=True)],
            ]
        )
        press = np.array([[force_z * w for w in whole], [force_z * w for w in by_whole]], np.float32)
        rows = self._table[2 * knot : 2 * knot + 4]
        split = 6 * _KNOTS
        if stuck_knot == knot:
            sheared = (shear - held).astype(np.float32) @ rows[:, :split]
        else:
            sheared = shear.astype(np.float32) @ rows[:, :split]
            sheared -= held.astype(np.float32) @ self._table[2 * stuck_knot : 2 * stuck_knot + 4, :split]
        pressed = press @ rows[:, split:]
        sheared, pressed = sheared.reshape(3, 2, 3, _KNOTS), pressed.reshape(2, 2, 2, _KNOTS)
        profiles = np.empty((5, 4, _KNOTS), np.float32)
        profiles[:3, 0], profiles[3:, 0] = sheared[0, 0], pressed[0, 0]
        profiles[:3, 1], profiles[3:, 1] = sheared[1, 0], pressed[1, 0]
        profiles[:3, 2], profiles[3:, 2] = sheared[2, 0], 0.0
        profiles[:3, 3], profiles[3:, 3] = sheared[0, 1], pressed[0, 1]
        return profiles

    def _hermite(self, radius: float, knot: int) -> tuple[list[float], list[float]]:
        """Return weights of value and slope at a knot of the radius and at the next one, and their slopes."""
        per_step = 1.0 / self._radius_step
        f = radius * per_step - knot
        g = 1.0 - f
        weights = [g * g * (1.0 + 2.0 * f), g * g * f, f * f * (3.0 - 2.0 * f), -f * f * g]
        slopes = [-6.0 * f * g, g * (1.0 - 3.0 * f), 6.0 * f * g, f * (3.0 * f - 2.0)]
        return weights, [slope * per_step for slope in slopes]

    def _write(self, offset: Singles, profiles: Singles, force: Singles, rows: Singles) -> None:
        """Write signals and slopes, (8, 3, n), for sites offset by (2, n) depths."""
        square = np.einsum("in,in->n", offset, offset)
        place = square + np.float32(_HALF_WAY)
        np.divide(np.float32(-_HALF_WAY * self._knots_per_share), place, out=place)
        place += np.float32(self._knots_per_share + 0.5)
        near = place.astype(np.intp)
        found = profiles.take(near, axis=2, mode="clip")
        square *= np.float32(0.5)
        square -= self._half_squares.take(near, mode="clip")
        found[:, 0] += found[:, 3] * square
        along, twice_turned, straight, pressed, pushed = found  # each itself, by a, by m, (1/r) d/dr

        projected = force[:, 0] @ offset
        normal = along * projected
        normal += pressed
        radial = twice_turned * projected
        radial += pushed

        # Strains are offset times `spread`, and force times `shifted`
        spread, shifted = np.empty((ROWS, square.size), np.float32), np.empty((5, square.size), np.float32)
        spread[:3] = radial[:3]
        np.multiply(offset, radial[3], out=spread[3:5])
        spread[3:5] += force * twice_turned[0]
        np.multiply(offset, twice_turned[0], out=spread[5:7])
        spread[7] = pushed[0]
        shifted[:3] = straight[:3]
        np.multiply(offset, straight[3], out=shifted[3:])
        np.multiply(spread[:, None], offset, out=rows[:, 1:])
        rows[:5, 1:] += shifted[:, None] * force
        diagonals = rows.reshape(3 * ROWS, -1)
        diagonals[10:15:4] += radial[0]  # by x and y
        diagonals[16:21:4] += straight[0]  # by F_x and F_y

        rows[:3, 0] = normal[:3]
        np.multiply(offset, normal[3], out=rows[3:5, 0])
        rows[3:5, 0] += force * along[0]
        np.multiply(offset, along[0], out=rows[5:7, 0])
        rows[7, 0] = pressed[0]


def distance_knots(reach: float) -> Floats:
    """Return the distances from 0 to `reach`, in depths, at which the tables of `SlipSignals` have knots."""
    share = np.linspace(0.0, reach**2 / (reach**2 + _HALF_WAY), _KNOTS)
    return np.asarray(np.sqrt(_HALF_WAY * share / (1.0 - share)), np.float64)


@lru_cache
def slope_rows(contacts: int) -> Indices:
    """Return the rows that `SlipSignals.fill` writes for contacts one after the other, by parameter, (7 k,)."""
    return np.asarray(ROWS * np.arange(contacts)[:, None] + _SLOPES, np.intp).ravel()
