"""Signals of a flat face and of a straight edge as functions of a few parameters, with slopes for a fit."""

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.fitting.contact_model import DiscModel

_LINE_NODES = 16  # closer than a depth for edges of up to 16 depths
_TILT_STEP_DEPTHS = 0.1  # from the centre to each of the two discs whose difference is a tilt


class FlatFace:
    """Round flat face of a rigid object that sticks.

    Parameters are x, y, a, F_x, F_y, F_z and T_x, T_y, the sums of x f_z and y f_z about the centre. A tilt adds the
    pressure 3 T_x x / (2 pi a^4) / sqrt(1 - r^2 / a^2) (Johnson, Contact Mechanics, 1985, section 5.3), which is the
    slope of a Hertz pressure, T_x by T_x, and taken as a difference of two.

    Parameters
    ----------
    flat, hertz
        Discs of both profiles over the same sites.
    """

    def __init__(self, flat: DiscModel, hertz: DiscModel) -> None:
        self._flat = flat
        self._hertz = hertz
        self._step_m = _TILT_STEP_DEPTHS * float(hertz.depth_m.min())

    def __call__(self, parameters: Floats) -> tuple[Floats, Floats]:
        """Return the signals (3 n,) and slopes (8, 3 n)."""
        centre, radius, force, moments = parameters[:2], float(parameters[2]), parameters[3:6], parameters[6:]
        face = self._flat.signals(centre, radius)
        columns = face.value.reshape(3, -1)
        slopes = np.vstack(
            [*(force @ part.reshape(3, -1) for part in (face.by_x, face.by_y, face.by_radius)), columns, columns[:2]]
        )
        value = force @ columns
        for axis, moment in enumerate(moments):
            step = self._step_m * np.eye(2)[axis]
            ahead, behind = self._hertz.signals(centre + step, radius), self._hertz.signals(centre - step, radius)
            tilt, by_x, by_y, by_radius = (
                (getattr(ahead, part)[2].ravel() - getattr(behind, part)[2].ravel()) / (2.0 * self._step_m)
                for part in ("value", "by_x", "by_y", "by_radius")
            )
            value += moment * tilt
            slopes[:3] += moment * np.array([by_x, by_y, by_radius])
            slopes[6 + axis] = tilt
        return value, slopes


class StraightEdge:
    """Straight edge that presses evenly over its length, a row of Hertz discs of one radius, its half width.

    Parameters are x, y, half width, F_x, F_y, F_z, direction from x and half length.
    """

    def __init__(self, hertz: DiscModel) -> None:
        self._hertz = hertz
        nodes, weights = np.polynomial.legendre.leggauss(_LINE_NODES)
        self._line = list(zip(nodes.tolist(), (weights / 2.0).tolist(), strict=True))

    def __call__(self, parameters: Floats) -> tuple[Floats, Floats]:
        """Return the signals (3 n,) and slopes (8, 3 n)."""
        centre, radius, force = parameters[:2], float(parameters[2]), parameters[3:6]
        along = np.array([np.cos(parameters[6]), np.sin(parameters[6])])
        half_length = parameters[7]
        columns = np.zeros((3, 3 * len(self._hertz.sites_m)))
        slopes = np.zeros((8, columns.shape[1]))
        for node, weight in self._line:
            disc = self._hertz.signals(centre + node * half_length * along, radius)
            columns += weight * disc.value.reshape(3, -1)
            by_x, by_y, by_radius = (
                weight * (force @ part.reshape(3, -1)) for part in (disc.by_x, disc.by_y, disc.by_radius)
            )
            slopes[:3] += by_x, by_y, by_radius
            slopes[6] += node * half_length * (along[0] * by_y - along[1] * by_x)
            slopes[7] += node * (along[0] * by_x + along[1] * by_y)
        slopes[3:6] = columns
        return force @ columns, slopes
