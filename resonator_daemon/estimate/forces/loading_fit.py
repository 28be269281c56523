"""Scatter of K F, hysteresis and creep of loaded sites: the nonlinear part of the fit of loadings."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares

from resonator_daemon.base.arrays import Floats, Indices
from resonator_daemon.estimate.forces.loadings import LoadingSolution, Readings, StepMeans, Steps, felt_newton

DEFAULT_SCATTER: Final = 0.015  # of K F from touch to touch, where there are too few loadings
LITTLE_SCATTER: Final = 1e-3  # nobody lays masses on better than that, so less is no reason to doubt one of them
SCATTER_RANGE: Final = (1e-6, 0.5)
# Hysteresis relative to the largest load, creep fraction, log of the creep time in seconds. These defaults, with a wide
# standard deviation, are used without data: no unloading, no creep.
RESPONSE_DEFAULT: Final = (0.01, 0.005, math.log(20.0))
RESPONSE_STD: Final = (0.02, 0.01, 1.0)
RESPONSE_LOWEST: Final = (0.0, 0.0, math.log(1.0))
RESPONSE_HIGHEST: Final = (0.25, 0.2, math.log(600.0))
RESPONSE_STEP: Final = (1e-4, 1e-5, 1e-3)  # newton, 1, 1: for derivatives


@dataclass(frozen=True, eq=False, slots=True)
class Response:
    """h in newtons, c and ln tau, common to all sites, with their covariance (3, 3)."""

    value: Floats
    covariance: Floats


@dataclass(frozen=True, eq=False, slots=True)
class LoadingFit:
    """y = intercept + slope F_e (1 + error of the masses that press), by site s and channel.

    `scatter` is the standard deviation of K F from step to step and channel to channel, relative; NaN without a
    degree of freedom.
    """

    site: Indices  # (s,)
    held: NDArray[np.bool_]  # (s,), True where loads of one size leave the intercept 0
    intercept: Floats  # (s, channels)
    slope: Floats  # (s, channels)
    intercept_variance: Floats  # (s, channels)
    slope_variance: Floats  # (s, channels)
    mass_variance: Floats  # (s, channels): the masses' part of the slope's variance
    scatter: float
    degrees_of_freedom: int
    response: Response | None


class LoadingProblem:
    """Loadings to be fitted, and their residuals."""

    def __init__(self, mass_newton: Floats, mass_std: Floats, steps: Steps, readings: Readings) -> None:
        """Initialise with at least one reading, of pressed sites alone, and positive masses."""
        self._masses = mass_newton, mass_std
        self._force = steps.pressing @ mass_newton
        self._steps, self._readings = steps, readings
        self.means = StepMeans(mass_newton, mass_std, steps, readings)

    def without(self, steps: Indices) -> "LoadingProblem":
        """Return the problem without the readings of some steps."""
        others = self._readings.of_steps(~np.isin(np.arange(len(self._steps.site)), steps))
        return LoadingProblem(*self._masses, self._steps, others)

    def fit(self, *, with_response: bool) -> LoadingFit:
        """Fit with the scatter that makes chi2 what it should be, and with hysteresis and creep if asked to."""
        response: Response | None = None
        scatter = self._scatter(None)
        if with_response:
            for _ in range(3):  # scatter and response each need the other
                response = self._response(response, scatter)
                scatter = self._scatter(response)
        solution = self._solution(_value(response), scatter)
        covariance = solution.covariance
        masses = covariance - solution.covariance_of_true_masses
        if response is not None:
            covariance = covariance + self._from_response(response, scatter)
        sites, channels = self.means.shape
        by_site = (2, sites, channels)
        used = slice(2 * sites * channels)
        intercept, slope = solution.value[used].reshape(by_site)
        intercept_variance, slope_variance = np.diag(covariance)[used].reshape(by_site)
        return LoadingFit(
            site=self.means.site_number,
            held=self.means.held,
            intercept=intercept,
            slope=slope,
            intercept_variance=intercept_variance,
            slope_variance=slope_variance,
            mass_variance=np.diag(masses)[used].reshape(by_site)[1],
            scatter=scatter,
            degrees_of_freedom=self._degrees_of_freedom(response),
            response=response,
        )

    def residual_newton(self, fit: LoadingFit) -> Floats:
        """Force (u,) by which each step's mean over readings and channels departs from `fit`, with nominal masses.

        NaN of a site that `fit` does not have.
        """
        intercept, slope = np.full((2, *self.means.shape), math.nan)
        known = np.isin(self.means.site_number, fit.site)
        intercept[known], slope[known] = fit.intercept, fit.slope
        intercept, slope = intercept[self.means.site], slope[self.means.site]
        felt = self._felt(_value(fit.response))
        residual = self.means.mean - intercept - slope * self.means.of_steps(felt)[:, None]
        return np.asarray((slope * residual).sum(axis=1) / (slope**2).sum(axis=1), np.float64)

    def deleted_chi2(self, fit: LoadingFit) -> Floats:
        """Residual (u,) of each step against all others, with the response of `fit` and its scatter, or a little."""
        return self._solution(_value(fit.response), max(fit.scatter, LITTLE_SCATTER)).deleted_chi2()

    def _felt(self, response: Floats | None) -> Floats:
        if response is None:
            return self._force[self._readings.step]
        hysteresis, fraction, log_time = response.tolist()
        return felt_newton(self._steps, self._force, self._readings, hysteresis, fraction, math.exp(log_time))

    def _solution(self, response: Floats | None, scatter: float) -> LoadingSolution:
        return LoadingSolution(self.means, self._felt(response), DEFAULT_SCATTER if math.isnan(scatter) else scatter)

    def _degrees_of_freedom(self, response: Response | None) -> int:
        rows = self.means.mean.size + len(self.means.mass_std)
        return int(rows - self.means.unknown.sum()) - (0 if response is None else len(response.value))

    def _scatter(self, response: Response | None) -> float:
        freedom = self._degrees_of_freedom(response)
        if freedom < 1:
            return math.nan

        def excess(log_scatter: float) -> float:
            return self._solution(_value(response), math.exp(log_scatter)).chi2 - freedom

        low, high = np.log(SCATTER_RANGE)
        if excess(low) <= 0:
            return 0.0
        if excess(high) >= 0:
            return SCATTER_RANGE[1]
        return math.exp(brentq(excess, low, high, xtol=1e-3))

    def _response(self, start: Response | None, scatter: float) -> Response:
        """Fit h, c and ln tau with all else eliminated: the projected residuals' Jacobian holds its uncertainty too."""
        scale = np.array([self._force.max(), 1.0, 1.0])

        def residual(response: Floats) -> Floats:
            from_default = (response / scale - RESPONSE_DEFAULT) / RESPONSE_STD
            return np.append(self._solution(response, scatter).whitened(), from_default)

        def jacobian(response: Floats) -> Floats:
            return _derivatives(residual, response)

        fit = least_squares(
            residual,
            scale * RESPONSE_DEFAULT if start is None else start.value,
            bounds=(scale * RESPONSE_LOWEST, scale * RESPONSE_HIGHEST),
            x_scale=scale * RESPONSE_STD,
            jac=jacobian,
        )
        change = jacobian(fit.x)
        covariance = np.asarray(np.linalg.inv(change.T @ change), dtype=np.float64)
        solution = self._solution(fit.x, scatter)
        # A common mode that wanders during a hold looks like creep; the residual that no creep explains shows how much.
        covariance *= max(1.0, solution.within_chi2_per_freedom())
        # Creep is seen as a share of the slopes, which the residuals take for known.
        covariance[1, 1] += fit.x[1] ** 2 * solution.slope_variance
        return Response(fit.x, covariance)

    def _from_response(self, response: Response, scatter: float) -> Floats:
        """Covariance (p, p) of the linear unknowns that the response's uncertainty adds."""
        change = _derivatives(lambda moved: self._solution(moved, scatter).value, response.value)
        return change @ response.covariance @ change.T


def _derivatives(function: Callable[[Floats], Floats], response: Floats) -> Floats:
    """Forward differences (k, 3): at 0, where a plate without hysteresis lies, there is no other side."""
    base = function(response)
    steps = np.diag(RESPONSE_STEP)
    return np.stack([(function(response + step) - base) / step.sum() for step in steps], axis=1)


def _value(response: Response | None) -> Floats | None:
    return None if response is None else response.value
