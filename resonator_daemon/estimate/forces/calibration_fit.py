"""Codes of sites from known masses: f0, signed K, scatter and response; doubtful steps are named."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import fdtri

from resonator_daemon.base.arrays import Floats, Indices
from resonator_daemon.estimate.forces.loading_fit import LoadingFit, LoadingProblem
from resonator_daemon.estimate.forces.loadings import Readings, Steps
from resonator_daemon.estimate.forces.site_response import SiteResponse
from resonator_daemon.estimate.forces.swapped_loads import swapped_steps

CHANCE: Final = 1e-3  # that a calibration without a bad loading has a doubtful one
RIVAL_GAP: Final = 13.8  # of chi2, between the bad step and another that it may be: odds of 1000 : 1


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
    doubtful, fit = _without_doubtful(problem, mass_newton, mass_std, steps, readings, with_response)
    means = problem.means
    residual_newton = np.full(len(steps.site), math.nan)
    residual_newton[means.step] = problem.residual_newton(fit)
    if len(fit.site) < len(means.held):  # of a site that was left out: about a fit with it
        left_out = np.isin(np.arange(len(steps.site)), doubtful)
        residual_newton[left_out] = problem.residual_newton(problem.fit(with_response=with_response))[
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


def _without_doubtful(
    problem: LoadingProblem,
    mass_newton: Floats,
    mass_std: Floats,
    steps: Steps,
    readings: Readings,
    with_response: bool,
) -> tuple[Indices, LoadingFit]:
    """Fit without the step that all others contradict; if it is ambiguous, without all steps of its site.

    A step is judged by the scatter of the others: one bad loading widens the scatter of all enough to hide in it.
    """
    means = problem.means
    none = np.zeros(0, dtype=np.intp)
    fit = problem.fit(with_response=with_response)
    channels = means.shape[1]
    if fit.degrees_of_freedom <= channels:
        return none, fit

    def fit_without(doubtful: Indices) -> LoadingFit:
        others = readings.of_steps(~np.isin(np.arange(len(steps.site)), doubtful))
        return LoadingProblem(mass_newton, mass_std, steps, others).fit(with_response=with_response)

    suspect = int(np.argmax(problem.deleted_chi2(fit)))
    fit_of_others = fit_without(means.step[[suspect]])
    chi2 = problem.deleted_chi2(fit_of_others)
    gate = fdtri(channels, fit_of_others.degrees_of_freedom, 1.0 - CHANCE / len(means.step))
    if chi2[suspect] <= channels * gate:
        return none, fit
    doubtful = means.step[(means.site == means.site[suspect]) & (chi2 > chi2[suspect] - RIVAL_GAP)]
    if len(doubtful) == 1:
        return doubtful, fit_of_others
    if len(doubtful) == len(means.step):
        return doubtful, fit
    return doubtful, fit_without(doubtful)


def _site_response(fit: LoadingFit) -> SiteResponse | None:
    if fit.response is None:
        return None
    hysteresis, fraction, log_time = fit.response.value.tolist()
    hysteresis_std, fraction_std, log_time_std = np.sqrt(np.diag(fit.response.covariance)).tolist()
    time_s = math.exp(log_time)
    return SiteResponse(hysteresis, fraction, time_s, hysteresis_std, fraction_std, time_s * log_time_std)
