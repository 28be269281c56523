"""Decoder of sites anywhere under an infinite plane, by the covariances of a stationary prior.

Nothing ends at the border of the sites: the prior holds on the whole plane, so that a load outside the array or across
its border is estimated like any other. For Gaussian fields the estimate, C_fs (C_ss + R)^-1 s, is the Bayes estimate.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BarycentricInterpolator
from scipy.spatial.distance import cdist

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.decoded import Decoded, check_gain, noise_of_signals, positions, positive
from resonator_daemon.estimate.surface.layout import as_grid, at_border, refuse_duplicates
from resonator_daemon.estimate.surface.open_plane.grid_modes import LEVELS, GridCovariance, GridModes
from resonator_daemon.estimate.surface.open_plane.linear_map import Estimate, LinearMap, ModeSet
from resonator_daemon.estimate.surface.open_plane.modes import DenseModes, Modes, ScaleGrid
from resonator_daemon.estimate.surface.open_plane.prior_tables import Field, StationaryPrior
from resonator_daemon.estimate.surface.skin import DEFAULT_PRIOR, Prior

_SCALES = np.logspace(-1.0, 4.0, 126)  # standard deviation of f_z over the traction that makes a signal of the noise
_CONTACT_FACTOR = 1.4  # of the standard deviation under contacts, for equal power of all components ...
_CONTACT_EXPONENT = -0.11  # ... and how it goes with the tangential ratio

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


class OpenPlaneDecoder:
    """Linear minimum-mean-square estimate of tractions and displacements on the infinite plane.

    Sites that form a regular grid at one depth, with equal noise in each channel, decode by the grid's symmetry in a
    reduced basis: the same answer, more than ten times sooner.

    Parameters
    ----------
    half_space
    site_positions_m
        (n, 2). A grid counts as one when its rows follow each other, x running first.
    depth_m
        Of all sites, or of each (n,); above 0.
    noise_std
        Standard deviation of the noise of the dimensionless signals, broadcastable to (3, n), or (3,).
    gain_std
        Relative standard deviation of the signals' gains: (1.5 gain_std rms)^2 is added to the noise variance, rms that
        of the frame's signals; where the noise differs between signals, in proportion to it.
    query_positions_m
        Where the traction is asked for, (m, 2); by default at the sites.
    prior
        Prior of the traction. A standard deviation holds at the declared noise; noise beyond that raises both in
        proportion.

    Attributes bear the names of these parameters, broadcast: `depths_m` (n,), `noise_std` (3, n).

    Raises
    ------
    ValueError
        A shape that does not fit, a parameter out of its range, two sites at the same place.
    """

    def __init__(
        self,
        half_space: HalfSpace,
        site_positions_m: ArrayLike,
        depth_m: ArrayLike,
        noise_std: ArrayLike,
        *,
        gain_std: float = 0.0,
        query_positions_m: ArrayLike | None = None,
        prior: Prior = DEFAULT_PRIOR,
    ) -> None:
        sites = self.site_positions_m = positions("site_positions_m", site_positions_m)
        count = len(sites)
        depths = self.depths_m = positive("depth_m", depth_m, (count,))
        noise = self.noise_std = noise_of_signals(noise_std, (count,))
        places = sites if query_positions_m is None else positions("query_positions_m", query_positions_m)
        check_gain(gain_std)
        refuse_duplicates(sites, depths)
        self.half_space = half_space
        self.gain_std = gain_std
        self.query_positions_m = places
        self.prior = prior

        unit_pascal = 2.0 * half_space.shear_modulus_pascal * float(np.sqrt(np.mean(noise**2)))
        scales = _SCALES**2 if prior.std_pascal is None else np.array([(prior.std_pascal / unit_pascal) ** 2])
        stationary = StationaryPrior(half_space, prior, unit_pascal)
        grid = as_grid(sites)
        modes: dict[float, Modes]
        if grid and query_positions_m is None and np.ptp(depths) == 0.0 and not np.ptp(noise, axis=1).any():
            whole = GridCovariance(stationary, grid, float(depths[0]), noise[:, 0], float(scales.max()))
            modes = {level.power: GridModes(whole, level) for level in LEVELS}
        else:
            covariance = SiteCovariance(stationary, sites, depths)
            modes = {
                np.inf: DenseModes(
                    covariance.signals(),
                    covariance.surface("traction", places),
                    covariance.surface("displacement", places),
                    noise.ravel(),
                    scales,
                )
            }
        log_noise = np.log(noise).ravel()
        self._map = LinearMap(
            [ModeSet(level, kept, ScaleGrid(kept.eigenvalues, scales, log_noise)) for level, kept in modes.items()],
            noise.ravel(),
            gain_std,
            np.repeat(stationary.traction_variance, len(places)),
            _CONTACT_FACTOR * prior.tangential_ratio**_CONTACT_EXPONENT,
            at_border(sites, places),
        )
        self._count = count
        self._places = len(places)
        self._shape = grid.shape if grid else None
        self._asks_at_sites = query_positions_m is None

    def decode(self, signals: ArrayLike, *, displacement: bool = False) -> Decoded:
        """Return tractions, and displacements if asked for, of frames of signals [3 p_n / (2 E), eps_xz, eps_yz].

        Parameters
        ----------
        signals
            Shape (..., 3, n), or (..., 3, ny, nx) for a grid; dimensionless. A signal that is NaN, infinite or beyond
            10 counts as lost and drops out of the model, alone; the error bars around it widen.
        displacement
            Also the surface displacement that the decoded traction causes, alone on the plane.

        Returns
        -------
        Decoded
            Of shape (..., 3, m), or (..., 3, ny, nx) for signals that came so where no queries were given.
            `traction_std_pascal`: posterior standard deviation at the frame's scale, larger under a contact, where a
            stationary prior makes it too small. `chi2`: mean square of the innovation in units of prior and noise.
            `border_contact`: f_z among the outermost sites or outside reaches 15 % of its peak. `status`: "ok", where
            `reason` counts lost signals; "no_signal", less than half of the signals known; "rejected", the residual
            exceeds ten times the noise and half of the energy, so that no load explains the frame.

        Raises
        ------
        ValueError
            Signals of another shape, or not numbers.
        """
        frames, leading, shape = self._frames(signals)
        if not leading:
            return self._map.estimate(frames[0], shape).decoded(displacement)
        decoded = [self._map.estimate(frame, shape).decoded(displacement) for frame in frames]
        return Decoded.stack(decoded, leading, shape)

    def estimate(self, signals: ArrayLike) -> Estimate:
        """Estimate the surface from one frame, (3, n) or (3, ny, nx), as `decode` does, as far as it is asked for."""
        (frame,), _, shape = self._frames(signals)
        return self._map.estimate(frame, shape)

    def scores_and_predictions(self, signals: ArrayLike) -> tuple[Floats, Floats]:
        """Return the deviation of each signal from what all others predict, and this prediction.

        Both are in standard deviations of the deviation, of the shape of the signals. A sound site stays within 5. A
        dead one or a wrong gain shows where a load is near; NaN for lost signals.
        """
        frames, _, _ = self._frames(signals)
        both = np.array([self._map.scores_and_predictions(frame) for frame in frames]).reshape(-1, 2, 3 * self._count)
        scores, predicted = np.moveaxis(both, 1, 0).reshape(2, *np.shape(signals))
        return scores, predicted

    def _frames(self, signals: ArrayLike) -> tuple[Floats, tuple[int, ...], tuple[int, ...]]:
        """Return the frames (k, 3 n), the leading axes, and the shape of a frame's surface arrays."""
        frames = np.asarray(signals, np.float64)
        flat = (3, self._count)
        if self._shape and frames.shape[-3:] == (3, *self._shape):
            shape = (3, *self._shape) if self._asks_at_sites else (3, self._places)
            return frames.reshape(-1, 3 * self._count), frames.shape[:-3], shape
        if frames.shape[-2:] != flat:
            grid = f" or (..., 3, {self._shape[0]}, {self._shape[1]})" if self._shape else ""
            raise ValueError(f"signals have shape {frames.shape}, must be (..., 3, {self._count}){grid}")
        return frames.reshape(-1, 3 * self._count), frames.shape[:-2], (3, self._places)
