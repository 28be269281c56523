"""Where a contact may be, before anything is known of it: every centre tried, its force by linear least squares."""

from typing import NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel

_STEP_DEPTHS = 0.5  # a fit finds the centre from there
_CENTRES_MAX = 4000
_RADII_DEPTHS = (0.7, 2.0)  # a disc in between looks much the same


class Candidate(NamedTuple):
    """A place that explains the signals better than those around it."""

    centre_m: Floats  # (2,)
    radius_m: float
    force_newton: Floats  # (3,)


class CentreSearch:
    """A raster of centres, each with discs of a few radii.

    Parameters
    ----------
    model
    noise_std
        Of the signals, (3 n,).
    lowest_m, highest_m
        Corners of the rectangle of centres, (2,).
    """

    def __init__(self, model: DiscModel, noise_std: Floats, lowest_m: Floats, highest_m: Floats) -> None:
        depth_m = float(model.depth_m.min())
        side_m = highest_m - lowest_m
        step_m = max(_STEP_DEPTHS * depth_m, float(np.sqrt(side_m.prod() / _CENTRES_MAX)))
        axes = [
            np.linspace(low, high, 2 + int((high - low) / step_m))
            for low, high in zip(lowest_m, highest_m, strict=True)
        ]
        self.centres_m = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        self.radii_m = np.array([min(radius * depth_m, model.radius_max_m) for radius in _RADII_DEPTHS])
        self._apart_m = 2.0 * depth_m
        columns = [
            model.signals(centre, float(radius)).value.reshape(3, -1) / noise_std
            for centre in self.centres_m
            for radius in self.radii_m
        ]
        self._columns = np.array(columns, np.float32)  # (centres x radii, 3, 3 n)
        self._known: Bools = np.zeros(noise_std.size, np.bool_)
        self._covariance: Floats = np.empty((0, 3, 3))

    def candidates(self, whitened: Floats, known: Bools, count: int) -> list[Candidate]:
        """Return the best places for whitened signals (3 n,), lost ones 0, best first.

        They lie at least two depths apart, and their discs press.
        """
        covariance = self._force_covariance(known)
        columns = self._columns.reshape(-1, whitened.size)
        seen = (columns @ whitened.astype(np.float32)).reshape(-1, 3, 1).astype(np.float64)
        forces = (covariance @ seen)[..., 0]
        fall = np.where(forces[:, 2] > 0.0, np.sum(forces * seen[..., 0], axis=1), 0.0)
        fall = fall.reshape(len(self.centres_m), -1)
        best_radius = fall.argmax(axis=1)
        fall = fall.max(axis=1)
        found: list[Candidate] = []
        while len(found) < count and fall.max() > 0.0:
            place = int(fall.argmax())
            radius = int(best_radius[place])
            force = forces[place * len(self.radii_m) + radius]
            found.append(Candidate(self.centres_m[place], float(self.radii_m[radius]), force))
            fall[np.hypot(*(self.centres_m - self.centres_m[place]).T) < self._apart_m] = 0.0
        return found

    def force_std_newton(self, known: Bools) -> Floats:
        """Error of the force of the smaller disc, if it were at a centre: (centres, 3)."""
        smaller = self._force_covariance(known)[:: len(self.radii_m)]
        return np.asarray(np.sqrt(np.diagonal(smaller, axis1=1, axis2=2)), np.float64)

    def _force_covariance(self, known: Bools) -> Floats:
        """Of each place, (centres x radii, 3, 3); kept for as long as the same signals are known."""
        if not np.array_equal(known, self._known):
            columns = self._columns * known
            precision = (columns @ columns.transpose(0, 2, 1)).astype(np.float64)
            least = 1e-9 * float(np.trace(precision, axis1=1, axis2=2).max())  # where nothing is felt, a large error
            self._covariance = np.asarray(np.linalg.inv(precision + least * np.eye(3)), np.float64)
            self._known = known
        return self._covariance
