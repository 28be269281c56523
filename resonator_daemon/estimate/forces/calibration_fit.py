"""Codes of sites from known masses, f0, signed K, scatter and response, and temperature terms from a sweep.

Doubtful steps and exchanged loads are named.
"""

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from scipy.special import chdtri, fdtri

from resonator_daemon.base.arrays import Floats, Indices
from resonator_daemon.estimate.forces.force_sites import SiteResponse
from resonator_daemon.estimate.forces.loading_fit import LoadingFit, LoadingProblem
from resonator_daemon.estimate.forces.loadings import Readings, StepMeans, Steps

CHANCE: Final = 1e-3  # that a calibration without a bad loading has a doubtful one, or exchanged ones
RIVAL_GAP: Final = 13.8  # of chi2, between two explanations: odds of 1000 : 1

LOAD_STD: Final = (0.03, 0.01)  # relative to the load, to the largest load: scatter and hysteresis need no exchange


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationFit:
    """Result of a calibration with known masses: of s loaded sites, and of all sites in common.

    Standard deviations hold counter, common mode, scatter, the response's parameters and the masses; not an error of
    the common mode that stays through all steps, which moves f0 by as much. `model_error` is the scatter of K F from
    touch to touch and channel to channel, relative; NaN for too few loadings. `doubtful_steps` were not used:
    one that contradicts all others, or all of a site among which the bad one is ambiguous. Only where no other steps
    are left were they used.
    """

    site: Indices  # (s,); a site that only has doubtful steps is not there
    f0_hz: Floats  # (s, channels)
    f0_std: Floats  # (s, channels), relative; NaN where loads of one size left f0 (and K with it) to the plate file
    sensitivity: Floats  # (s, channels), 1/N, signed
    sensitivity_std: Floats  # (s, channels), 1/N
    sensitivity_mass_std: Floats  # (s, channels), 1/N: the masses' part
    model_error: float
    model_error_std: float
    residual_newton: Floats  # (t,) of each step's mean, NaN where it was not read
    site_residual_newton: Floats  # (s,), rms over all steps, doubtful ones included
    doubtful_steps: tuple[int, ...]
    swapped_steps: tuple[int, int] | None  # steps whose loads, exchanged, explain what was read: a reason to refuse
    response: SiteResponse | None
    force_range_newton: tuple[float, float]


def fit_calibration(
    f0_hz: Floats,
    sensitivity: Floats,
    mass_newton: Floats,
    mass_std: Floats,
    steps: Steps,
    readings: Readings,
    *,
    with_response: bool,
) -> CalibrationFit:
    """Fit y = 1 - f0 / f = a + b F_e: by eq. (1) the true f0 is f0 / (1 - a), and K is b / (1 - a).

    Parameters
    ----------
    f0_hz, sensitivity
        (sites, channels) of the plate file. The sign of the sensitivity shows exchanged loads where only two were used.
    mass_newton, mass_std
        (masses,) weight of each mass and its relative standard deviation, common to all that it is laid on.
    with_response
        Fit hysteresis and creep, common to all sites, too: from loading and unloading, with holds. Otherwise a site
        is taken to feel what presses.
    """
    problem = LoadingProblem(mass_newton, mass_std, steps, readings)
    doubtful, fit = _without_doubtful(problem, with_response)
    means = problem.means
    residual_newton = np.full(len(steps.site), math.nan)
    residual_newton[means.step] = problem.residual_newton(fit)
    if len(fit.site) < len(means.held):  # of a site that was left out: about a fit with it
        unused = np.isin(np.arange(len(steps.site)), doubtful)
        residual_newton[unused] = problem.residual_newton(problem.fit(with_response=with_response))[
            np.isin(means.step, doubtful)
        ]
    squares = residual_newton**2
    rest = 1.0 - fit.intercept
    # Masses of one set may all be off by the same share. No residual shows that; K is off by as much.
    mass_std_of_slope = np.maximum(np.sqrt(fit.mass_variance), mass_std.max() * np.abs(fit.slope))
    freedom = fit.degrees_of_freedom
    return CalibrationFit(
        site=fit.site,
        f0_hz=f0_hz[fit.site] / rest,
        f0_std=np.where(fit.held[:, None], math.nan, np.sqrt(fit.intercept_variance)),
        sensitivity=fit.slope / rest,
        sensitivity_std=np.sqrt(fit.slope_variance - fit.mass_variance + mass_std_of_slope**2),
        sensitivity_mass_std=mass_std_of_slope,
        model_error=fit.scatter,
        model_error_std=fit.scatter / math.sqrt(2 * freedom) if freedom > 0 else math.nan,
        residual_newton=residual_newton,
        site_residual_newton=np.array([math.sqrt(np.nanmean(squares[steps.site == m])) for m in fit.site]),
        doubtful_steps=tuple(doubtful.tolist()),
        swapped_steps=swapped_steps(means, sensitivity[means.site_number]),
        response=_site_response(fit),
        force_range_newton=(float(means.force.min()), float(means.force.max())),
    )


def _without_doubtful(problem: LoadingProblem, with_response: bool) -> tuple[Indices, LoadingFit]:
    """Fit without the step that all others contradict; if it is ambiguous, without all steps of its site.

    A step is judged by the scatter of the others: one bad loading widens the scatter of all enough to hide in it.
    """
    means = problem.means
    none = np.zeros(0, dtype=np.intp)
    fit = problem.fit(with_response=with_response)
    channels = means.shape[1]
    if fit.degrees_of_freedom <= channels:
        return none, fit

    suspect = int(np.argmax(problem.deleted_chi2(fit)))
    fit_of_others = problem.without(means.step[[suspect]]).fit(with_response=with_response)
    chi2 = problem.deleted_chi2(fit_of_others)
    gate = fdtri(channels, fit_of_others.degrees_of_freedom, 1.0 - CHANCE / len(means.step))
    if chi2[suspect] <= channels * gate:
        return none, fit
    doubtful = means.step[(means.site == means.site[suspect]) & (chi2 > chi2[suspect] - RIVAL_GAP)]
    if len(doubtful) == 1:
        return doubtful, fit_of_others
    if len(doubtful) == len(means.step):
        return doubtful, fit
    return doubtful, problem.without(doubtful).fit(with_response=with_response)


def _site_response(fit: LoadingFit) -> SiteResponse | None:
    if fit.response is None:
        return None
    hysteresis, fraction, log_time = fit.response.value.tolist()
    hysteresis_std, fraction_std, log_time_std = np.sqrt(np.diag(fit.response.covariance)).tolist()
    time_s = math.exp(log_time)
    return SiteResponse(hysteresis, fraction, time_s, hysteresis_std, fraction_std, time_s * log_time_std)


def swapped_steps(means: StepMeans, sensitivity: Floats) -> tuple[int, int] | None:
    """Two steps of one site whose loads were exchanged, of the site that shows it most; None where no site does.

    `sensitivity` (s, channels) is that of the plate file: of two loads, or of three at equal distances, the line goes
    through the exchanged ones as well, but with the sign of K reversed on all channels.
    """
    found: list[tuple[float, tuple[int, int]]] = []
    for site, expected in enumerate(sensitivity):
        rows = np.flatnonzero(means.site == site)
        shift, force = means.mean[rows], means.force[rows]
        if means.held[site]:
            continue
        gate = chdtri(max((len(rows) - 2) * shift.shape[1], 1), CHANCE)
        as_stated = _chi2(shift, force, expected)
        if as_stated <= gate:
            continue
        exchanged = [
            (_chi2(shift, _exchange(force, i, j), expected), (int(means.step[rows[i]]), int(means.step[rows[j]])))
            for i, j in combinations(range(len(rows)), 2)
            if force[i] != force[j]
        ]
        best, pair = min(exchanged)
        if best <= gate and as_stated - best > RIVAL_GAP:
            found.append((best - as_stated, pair))
    return min(found)[1] if found else None


def _exchange(force: Floats, i: int, j: int) -> Floats:
    result = force.copy()
    result[[i, j]] = force[[j, i]]
    return result


def _chi2(shift: Floats, force: Floats, expected: Floats) -> float:
    """Return chi2 of a line through shifts (k, channels) over loads (k,); infinite if no slope has the right sign."""
    weight = 1.0 / np.hypot(LOAD_STD[0] * force, LOAD_STD[1] * force.max()) ** 2
    off = force - weight @ force / weight.sum()
    slope = (weight * off) @ shift / ((weight * off) @ off)
    if (slope * expected < 0).all():
        return math.inf
    residual = shift - weight @ shift / weight.sum() - off[:, None] * slope
    return float((weight @ (residual / slope) ** 2).sum())


@dataclass(frozen=True, eq=False, slots=True)
class TemperatureFit:
    """Coefficients (m, 3) of d, d^2 and d^3 in 1/K, 1/K^2 and 1/K^3, with their standard deviations."""

    coefficient: Floats
    coefficient_std: Floats


def fit_temperature(
    plate_kelvin: Floats,
    shift: Floats,
    shift_std: Floats,
    default: Floats,
    default_std: Floats,
    reference_kelvin: float,
) -> TemperatureFit:
    """Fit the shifts of sites untouched, or all the while under one load, at different plate temperatures.

    Parameters
    ----------
    plate_kelvin
        (n,) temperatures, changing so slowly that plate and thermometer agree.
    shift, shift_std
        (n, m) y = 1 - f0 / f by site, and its standard deviation (m,), relative. A constant is fitted to each site too.
    default, default_std
        (3,) coefficients of such plates and how they differ. They carry what the span of the sweep leaves open.
    """
    powers = (plate_kelvin - reference_kelvin)[:, None] ** np.array([1, 2, 3])
    centred = powers - powers.mean(axis=0)  # takes each site's constant out
    off_default = shift - shift.mean(axis=0) - (centred @ default)[:, None]
    scaled = centred * default_std
    # In units of default_std the prior is the identity.
    information = (scaled.T @ scaled) / shift_std[:, None, None] ** 2 + np.eye(3)
    right = (scaled.T @ off_default / shift_std**2).T
    covariance = np.linalg.inv(information)
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    step = (covariance @ right[:, :, None])[:, :, 0]
    return TemperatureFit(default + step * default_std, std * default_std)
