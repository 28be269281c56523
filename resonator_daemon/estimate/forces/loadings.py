"""Known masses on sites, step by step, and the linear least squares of all of their readings at once."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from resonator_daemon.base.arrays import Floats, Indices


@dataclass(frozen=True, eq=False, slots=True)
class Steps:
    """Every change of the load on a site, taking masses off included.

    `pressing` lists which masses lie on the site from `since_s` until the site's next step. `common_std` is the
    standard deviation, relative, of what shifts all channels alike for as long as the step lasts: the held common mode.
    """

    site: Indices  # (t,)
    since_s: Floats  # (t,)
    pressing: NDArray[np.bool_]  # (t, masses)
    common_std: Floats  # (t,)
    plate_kelvin: Floats  # (t,), NaN where not known


@dataclass(frozen=True, eq=False, slots=True)
class Readings:
    """Readings y = 1 - f0 / f against the plate file's f0, common mode taken out; only those with all channels.

    Both standard deviations are relative and independent from reading to reading: `noise_std` that of the counter, of
    each channel alone, `oscillator_std` of all channels alike.
    """

    step: Indices  # (n,)
    time_s: Floats  # (n,)
    shift: Floats  # (n, channels)
    noise_std: Floats  # (n, channels)
    oscillator_std: Floats  # (n,)

    def of_steps(self, wanted: NDArray[np.bool_]) -> "Readings":
        """Return the readings of the selected steps (t,)."""
        used = wanted[self.step]
        return Readings(
            self.step[used], self.time_s[used], self.shift[used], self.noise_std[used], self.oscillator_std[used]
        )


def felt_newton(
    steps: Steps,
    force_newton: Floats,
    readings: Readings,
    hysteresis_newton: float,
    creep_fraction: float,
    creep_time_s: float,
) -> Floats:
    """Force (n,) that the site felt at each reading, of steps of `force_newton` (t,) on sites that had rested.

    The model is that of SiteResponse. A step is sudden: play depends on where a force turns, not on how fast it moves.
    """
    play = np.zeros(len(steps.site))
    crept = np.zeros(len(steps.site))  # at the start of the step
    last: dict[int, int] = {}
    for step in np.argsort(steps.since_s, kind="stable").tolist():
        newton, z, u = float(force_newton[step]), 0.0, 0.0
        before = last.get(int(steps.site[step]))
        if before is not None:
            passed_s = float(steps.since_s[step] - steps.since_s[before])
            u = float(force_newton[before])
            u += (float(crept[before]) - u) * math.exp(-passed_s / creep_time_s)
            z = float(play[before])
        play[step] = min(max(z, newton - hysteresis_newton), newton + hysteresis_newton)
        crept[step] = u
        last[int(steps.site[step])] = step
    at = readings.step
    force = force_newton[at]
    creep = force + (crept[at] - force) * np.exp((steps.since_s[at] - readings.time_s) / creep_time_s)
    return (1.0 - creep_fraction) * (force + play[at]) / 2.0 + creep_fraction * creep


class StepMeans:
    """The loadings of a calibration, as the mean of each step and what varies within it.

    The held common mode and the scatter of K F are those of a step, so they stay in its mean: many readings of one
    touch are still one touch.
    """

    def __init__(self, mass_newton: Floats, mass_std: Floats, steps: Steps, readings: Readings) -> None:
        """Initialise with at least one reading, of pressed sites alone, and positive masses."""
        self.mass_std = mass_std
        self.step, self.row = np.unique(readings.step, return_inverse=True)  # (u,) read, (n,) into them
        self._of_step = csr_array((np.ones(len(self.row)), (self.row, np.arange(len(self.row)))))  # (u, n)
        self._weight = 1.0 / ((readings.noise_std**2).mean(axis=1) + readings.oscillator_std**2)
        total = np.bincount(self.row, self._weight)
        self._weight /= total[self.row]
        self.mean = self.of_steps(readings.shift)  # (u, channels)
        spread = self._weight[:, None]
        self.variance = self.of_steps(spread * readings.noise_std**2)  # (u, channels), of the mean, per channel
        oscillator = self.of_steps(spread * readings.oscillator_std[:, None] ** 2)[:, 0]
        self.common_variance = oscillator + steps.common_std[self.step] ** 2  # (u,), of all channels alike
        root = _root(readings.noise_std**2, readings.oscillator_std**2)
        self.within_inverse_root = np.asarray(np.linalg.inv(root), dtype=np.float64)  # (n, channels, channels)
        within = readings.shift - self.mean[self.row]
        self.within: Floats = np.einsum("ncd,nd->nc", self.within_inverse_root, within)

        self.mass_load = steps.pressing[self.step] * mass_newton  # (u, masses)
        self.force = self.mass_load.sum(axis=1)
        self.force_std = np.linalg.norm(self.mass_load * mass_std, axis=1) / self.force  # (u,), relative
        self.site_number, self.site = np.unique(steps.site[self.step], return_inverse=True)  # (s,), (u,) into them
        # Loads of one size do not separate intercept and slope: the intercept is held at 0.
        self.held: NDArray[np.bool_] = np.array(
            [np.ptp(self.force[self.site == site]) == 0 for site in range(len(self.site_number))]
        )
        self.shape = len(self.held), self.mean.shape[1]
        self.rough_slope = self._rough_slope()

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """(p,) of intercepts, slopes and errors of masses: True for what is not held."""
        channels = self.shape[1]
        others = np.ones(self.held.size * channels + len(self.mass_std), dtype=bool)
        return np.concatenate([~np.repeat(self.held, channels), others])

    def of_steps(self, of_readings: Floats) -> Floats:
        """Mean over each step (u, ...) of values (n, ...)."""
        return self.sums((self._weight * of_readings.T).T)

    def sums(self, of_readings: Floats) -> Floats:
        """Sum over each step (u, ...) of values (n, ...)."""
        sums = np.asarray(self._of_step @ of_readings.reshape(len(of_readings), -1), dtype=np.float64)
        return sums.reshape(-1, *of_readings.shape[1:])

    def _rough_slope(self) -> Floats:
        """Slopes (s, channels) by ordinary least squares, where some per cent do not matter."""
        slope = np.zeros(self.shape)
        for site, held in enumerate(self.held):
            here = self.site == site
            off = self.force[here] - (0.0 if held else self.force[here].mean())
            slope[site] = off @ self.mean[here] / (off @ off)
        return slope


class LoadingSolution:
    """Generalised least squares for one response and one scatter; unknowns are intercepts, slopes, errors of masses."""

    def __init__(self, means: StepMeans, felt_newton: Floats, scatter: float) -> None:
        """Initialise with the force that each reading's site felt (n,) and the relative scatter of K F."""
        self._means = means
        self._scatter = scatter
        self._mean_felt = means.of_steps(felt_newton)
        self._within_felt = felt_newton - self._mean_felt[means.row]
        slope = means.rough_slope[means.site]
        root = _root(means.variance + (scatter * slope * self._mean_felt[:, None]) ** 2, means.common_variance)
        unknown = means.unknown
        design = self._design(slope)[:, :, unknown]
        self._rows: Floats = np.asarray(np.linalg.solve(root, design), dtype=np.float64)
        mean: Floats = np.asarray(np.linalg.solve(root, means.mean[:, :, None])[:, :, 0], dtype=np.float64)

        rows = self._rows.reshape(-1, design.shape[2])
        normal = rows.T @ rows
        masses = np.arange(1, len(means.mass_std) + 1)
        normal[-masses, -masses] += means.mass_std[::-1] ** -2
        self._normal = normal
        self._inverse = _inverse(normal)
        solution = self._inverse @ (rows.T @ mean.ravel())
        self.value = np.zeros(len(unknown))  # (p,), 0 where held
        self.value[unknown] = solution
        self._mean_whitened = mean - self._rows @ solution

    @property
    def chi2(self) -> float:
        """Return chi2 of the steps' means and the masses."""
        return float((self._mean_whitened**2).sum() + (self._mass_whitened**2).sum())

    @property
    def covariance(self) -> Floats:
        """(p, p), 0 where held."""
        return self._with_held(self._inverse)

    @property
    def covariance_of_true_masses(self) -> Floats:
        """(p, p), as if the masses had exactly their nominal values."""
        known = len(self._normal) - len(self._means.mass_std)
        inverse = np.zeros(self._normal.shape)
        inverse[:known, :known] = _inverse(self._normal[:known, :known])
        return self._with_held(inverse)

    @property
    def slope_variance(self) -> float:
        """Return the relative variance of the error common to all slopes."""
        cells = int(np.prod(self._means.shape))
        used = slice(cells, 2 * cells)
        return 1.0 / float(np.sum(self.value[used] ** 2 / np.diag(self.covariance)[used]))

    def whitened(self) -> Floats:
        """Return all residuals by their standard deviations, those within steps included.

        All that varies within a step is off by one share, that of its masses and of its touch: its own gain, of which
        the residuals are two parts, the readings about it and itself by what gains scatter.
        """
        within, gain = self._within_whitened()
        parts = self._mean_whitened, within, gain, self._mass_whitened
        return np.concatenate([part.ravel() for part in parts])

    def within_chi2_per_freedom(self) -> float:
        """Of the readings about the means of their steps: 1 where they vary as felt and by their noise alone."""
        within, gain = self._within_whitened()
        return float((within**2).sum() / max(within.size - 2 * gain.size, 1))

    def deleted_chi2(self) -> Floats:
        """Residual (u,) of each step against a fit without it; 0 where the fit has nothing else."""
        left = np.eye(self._rows.shape[1]) - self._rows @ self._inverse @ self._rows.swapaxes(1, 2)
        inverse = np.linalg.pinv(left, rcond=1e-6, hermitian=True)
        return np.asarray(np.einsum("tc,tcd,td->t", self._mean_whitened, inverse, self._mean_whitened), np.float64)

    @property
    def _mass_whitened(self) -> Floats:
        masses = self._means.mass_std
        return self.value[-len(masses) :] / masses

    def _within_whitened(self) -> tuple[Floats, Floats]:
        """Residuals within steps (n, channels), and the gains (u, channels) taken out of them by their deviation.

        A gain is the same for all readings of a step, so many readings determine it well. It is of the step alone: what
        is left shows the time course of creep, and the steps' means show its share of a force.
        """
        means = self._means
        cells = int(np.prod(means.shape))
        slope = self.value[cells : 2 * cells].reshape(means.shape)[means.site]
        std = np.hypot(self._scatter, means.force_std)[:, None]
        felt = means.within_inverse_root * (slope[means.row] * self._within_felt[:, None])[:, None, :]
        residual = means.within - felt.sum(axis=2)
        scaled = felt * std[means.row][:, None]
        normal = means.sums(scaled.swapaxes(1, 2) @ scaled) + np.eye(means.shape[1])
        right = means.sums(np.einsum("ncg,nc->ng", scaled, residual))
        gain: Floats = np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], dtype=np.float64)
        return residual - np.einsum("ncg,ng->nc", scaled, gain[means.row]), gain

    def _design(self, slope: Floats) -> Floats:
        """Change of the steps' means (u, channels, p) with the unknowns."""
        means = self._means
        channels = means.shape[1]
        cells = int(np.prod(means.shape))
        design = np.zeros((*slope.shape, len(means.unknown)))
        step, channel = np.ogrid[: len(slope), :channels]
        cell = means.site[:, None] * channels + channel
        design[step, channel, cell] = 1.0
        design[step, channel, cells + cell] = self._mean_felt[:, None]
        design[:, :, 2 * cells :] = slope[:, :, None] * means.mass_load[:, None, :]
        return design

    def _with_held(self, of_unknown: Floats) -> Floats:
        unknown = self._means.unknown
        result = np.zeros((len(unknown), len(unknown)))
        result[np.ix_(unknown, unknown)] = of_unknown
        return result


def _root(variance: Floats, common_variance: Floats) -> Floats:
    """Lower root (k, channels, channels) of diag(variance) + common variance 11'."""
    channels = variance.shape[1]
    covariance = variance[:, :, None] * np.eye(channels) + common_variance[:, None, None]
    return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


def _inverse(normal: Floats) -> Floats:
    size = 1.0 / np.sqrt(np.diag(normal))  # unknowns have different units
    return size[:, None] * np.linalg.inv(normal * size * size[:, None]) * size
