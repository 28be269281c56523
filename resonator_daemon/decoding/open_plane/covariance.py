"""Covariance matrices of sites at any depths with each other and with what is asked for on the surface."""

import numpy as np
from scipy.interpolate import BarycentricInterpolator
from scipy.spatial.distance import cdist

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.open_plane.prior_tables import Field, StationaryPrior

_DEPTHS = 8  # tabulated at most; more depths than that are interpolated between Chebyshev's


class SiteCovariance:
    """Covariances under a prior of the signals of sites.

    Parameters
    ----------
    prior
    positions_m
        Of the sites, (n, 2).
    depths_m
        Of the sites, (n,), above 0.
    """

    def __init__(self, prior: StationaryPrior, positions_m: Floats, depths_m: Floats) -> None:
        self._prior = prior
        self._positions_m = positions_m
        self._tabulated_m, self._weights = _depth_weights(depths_m)

    def signals(self) -> Floats:
        """Of the signals with each other, (3 n, 3 n): all sites of the first channel, then of the second, the third."""
        count = len(self._positions_m)
        reach_m = _reach_m(self._positions_m, self._positions_m)
        matrix = np.zeros((3, count, 3, count))
        for row, row_weights in zip(self._tabulated_m, self._weights, strict=True):
            rows = np.flatnonzero(row_weights)
            for column, column_weights in zip(self._tabulated_m, self._weights, strict=True):
                columns = np.flatnonzero(column_weights)
                kernel = self._prior.kernel("sensor", row, "sensor", column, reach_m)
                block = kernel(self._positions_m[rows, None] - self._positions_m[columns])
                block *= (row_weights[rows, None] * column_weights[columns])[..., None, None]
                matrix[:, rows[:, None], :, columns] += block
        return matrix.reshape(3 * count, 3 * count)

    def surface(self, field: Field, positions_m: Floats) -> Floats:
        """Of the traction or displacement at `positions_m` (m, 2) with the signals, (3 m, 3 n)."""
        count, places = len(self._positions_m), len(positions_m)
        reach_m = _reach_m(positions_m, self._positions_m)
        matrix = np.zeros((3, places, 3, count))
        for depth_m, weights in zip(self._tabulated_m, self._weights, strict=True):
            columns = np.flatnonzero(weights)
            kernel = self._prior.kernel(field, 0.0, "sensor", depth_m, reach_m)
            block = kernel(positions_m[:, None] - self._positions_m[columns]) * weights[columns, None, None]
            matrix[..., columns] += block.transpose(2, 0, 3, 1)
        return matrix.reshape(3 * places, 3 * count)


def _depth_weights(depths_m: Floats) -> tuple[Floats, Floats]:
    """Return the depths to tabulate (d,) and what each contributes to each site (d, n).

    Signals are smooth in depth: for depths that differ by less than a factor of two, eight nodes leave less than 1e-6.
    """
    distinct, places = np.unique(depths_m, return_inverse=True)
    if distinct.size <= _DEPTHS:
        return distinct, np.eye(distinct.size)[:, places]
    nodes = np.cos(np.pi * (np.arange(_DEPTHS) + 0.5) / _DEPTHS)
    nodes = distinct[0] + (distinct[-1] - distinct[0]) * (nodes + 1.0) / 2.0
    return nodes, np.asarray(BarycentricInterpolator(nodes, np.eye(_DEPTHS))(depths_m), np.float64).T


def _reach_m(rows_m: Floats, columns_m: Floats) -> float:
    return float(cdist(rows_m, columns_m).max())
