"""Drift of a plate with all tones received: plate temperature and reference from untouched sites, and site offsets.

The relative shift of site m is y_m = a_m theta + b_m theta^2 + c_m theta^3 + g + o_m + K_m F_m with the temperature
theta of the plate above that of calibration, the reference's error g, and the site's own offset o_m. A thermal shock is
separated from a press by its rate, and because it moves all sites by their coefficients.

The Kalman filter does not keep the covariance of every offset with every other. Errors of theta and g that all offsets
make good for are invisible and stay as they were at the start (`theta_std_kelvin` has them); about them the offsets are
nearly independent, because theta is found again from many sites in every frame. So a variance per offset and one matrix
(2, 2) for theta and g are enough, and the cost of a frame grows with the number of sites.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Bools, Floats

THETA_START_KELVIN: Final = 20.0  # a plate at any temperature of a room, or on a warm robot
REFERENCE_START: Final = 3e-5  # crystal without compensation
THETA_WALK_KELVIN: Final = 0.1  # after one second: 2.4 K in ten minutes
REFERENCE_WALK: Final = 1e-9  # after one second: 2.4e-8 in ten minutes, a reference through 2 K
OFFSET_WALK: Final = 1e-10  # after one second: ageing of 5e-6 a year is 1e-10 in ten minutes
THERMOMETER_WALK_KELVIN: Final = 1e-3  # after one second
RATE_MEMORY_S: Final = 0.1
# A plate that has changed its temperature goes on doing so in ways that theta does not show: transients of its sites
# may hide its own change, and each site follows at its own pace.
TREND_MEMORY_S: Final = 1.0
TREND_FLOOR_KELVIN_PER_S: Final = 0.1  # what noise of theta makes of none
UNREST_S: Final = 10.0
RATE_MAX_KELVIN_PER_S: Final = 5.0  # faster than any plate; a press of all sites by 0.3 N looks like 6 K at -3e-7 / K
ON_SIGMAS: Final = 6.0
ON_FRAMES: Final = 2
OFF_SIGMAS: Final = 3.0
OFF_FRAMES: Final = 5
SITES_MIN: Final = 3  # fewer do not outvote a press
HUBER_SIGMAS: Final = 1.5
FIT_STEPS: Final = 20
FIT_TOLERANCE: Final = 0.2  # of a standard deviation: what is left after such a step is far less


class RandomWalks:
    """Independent random walks; `mean` and `variance` have the shape (n,), infinite variance for one never measured."""

    def __init__(self, count: int, start_std: float = math.inf) -> None:
        self._start_std = start_std
        self.mean: Floats = np.zeros(count)
        self.variance: Floats = np.full(count, start_std**2)

    def reset(self) -> None:
        self.mean[:] = 0.0
        self.variance[:] = self._start_std**2

    def measure(self, reading: Floats, reading_variance: Floats | float, where: NDArray[np.bool_]) -> None:
        """Update with readings (n,) of the walks in `where`."""
        total = self.variance + reading_variance
        known = np.isfinite(total) & (total > 0)
        gain = np.where(known, self.variance / np.where(known, total, 1.0), 1.0)
        after = np.where(known, gain * reading_variance, reading_variance)
        self.mean = np.where(where, self.mean + gain * (reading - self.mean), self.mean)
        self.variance = np.where(where, after, self.variance)


@dataclass(frozen=True, slots=True)
class DriftReading:
    """Compensation of one frame; the force on site m is (y_m - expected_shift[m]) / K_m.

    `theta_kelvin` is the plate's temperature above that of calibration, `held_s` the time since a site last showed it.
    `expected_std` (m,) is what `expected_shift` (m,) may be off by: drift, temperature coefficients, and offsets.
    """

    theta_kelvin: float
    theta_std_kelvin: float
    reference_shift: float
    held_s: float
    expected_shift: Floats
    expected_std: Floats
    in_contact: Bools


class _Common(NamedTuple):
    """Plate temperature theta and reference error g, as (2,), with their covariance (2, 2)."""

    mean: Floats
    covariance: Floats

    def shift(self, coefficients: Floats, warmth_kelvin: Floats | float = 0.0) -> Floats:
        a, b, c = coefficients
        kelvin = self.mean[0] + warmth_kelvin
        shift: Floats = kelvin * (a + kelvin * (b + kelvin * c)) + self.mean[1]
        return shift

    def slope(self, coefficients: Floats) -> Floats:
        a, b, c = coefficients
        theta = self.mean[0]
        slope: Floats = a + theta * (2.0 * b + 3.0 * theta * c)
        return slope

    def variance(self, slope: Floats) -> Floats:
        (theta, cross), (_, reference) = self.covariance
        variance: Floats = theta * slope**2 + 2.0 * cross * slope + reference
        return variance


class PlateDrift:
    """Kalman filter over plate temperature, reference error and one offset for each of m sites."""

    def __init__(
        self,
        temperature_coefficients: Floats,
        *,
        coefficient_std: float,
        offset_std: float,
        local_kelvin_std: float = 0.0,
    ) -> None:
        """Initialise with the calibration.

        Parameters
        ----------
        temperature_coefficients
            (3, m): a in 1/K, b in 1/K^2, c in 1/K^3 about the temperature of calibration.
        coefficient_std
            Standard deviation of a, 1/K.
        offset_std
            Spread of the sites' offsets since calibration, relative.
        local_kelvin_std
            Noise of a site's own thermometer, where it has one.
        """
        self._coefficients = temperature_coefficients
        self._coefficient_variance = coefficient_std**2
        self._local_variance = local_kelvin_std**2
        sites = temperature_coefficients.shape[1]
        self._offsets = RandomWalks(sites, offset_std)
        self._thermometers = RandomWalks(sites)  # what each reads above theta while untouched
        self.reset()

    def reset(self) -> None:
        """Reset the state to that of the calibration."""
        sites = self._coefficients.shape[1]
        self._offsets.reset()
        self._thermometers.reset()
        self._common = _Common(np.zeros(2), np.diag([THETA_START_KELVIN**2, REFERENCE_START**2]))
        self._start_variance = 0.0  # of theta, common to all later estimates
        self._started = False
        self._held_s = 0.0
        self._rate_kelvin_per_s = 0.0
        self._step_s = 0.0
        self._trend_kelvin_per_s = self._unrest_kelvin_per_s = 0.0
        self._followed = np.zeros(sites, dtype=bool)  # measured in the frame before
        self._anchor_kelvin = np.zeros(sites)  # plate's temperature when a site's offset was last measured
        self._above = np.zeros(sites, dtype=np.int64)
        self._below = np.zeros(sites, dtype=np.int64)
        self._in_contact = np.zeros(sites, dtype=bool)

    def tare(self, shift: Floats, variance: Floats) -> None:
        """Tare: set the shifts (m,), a mean of some frames, as those of untouched sites at the present temperature.

        NaN leaves its site as it was.
        """
        detected = self._detected(shift, variance)
        self._offsets.mean[detected] = (shift - self._common.shift(self._coefficients))[detected]
        self._offsets.variance[detected] = variance[detected]
        self._anchor_kelvin[detected] = self._common.mean[0]
        self._above[detected] = 0
        self._in_contact &= ~detected

    def update(
        self,
        shift: Floats,
        variance: Floats,
        dt_s: float,
        local_kelvin: Floats | None = None,
        pressed: Bools | bool = False,
        free: Bools | bool = False,
    ) -> DriftReading:
        """Update with one frame.

        Parameters
        ----------
        shift, variance
            (m,): combined relative shift y of each site and the variance of its noise; NaN where it is not known.
        dt_s
            Time since the frame before.
        local_kelvin
            (m,): temperature of the site by its own thermometer, whose zero is free; NaN where it has none.
        pressed, free
            (m,): sites that are known to be in contact, and not to be, whatever their shift is.
        """
        detected = self._detected(shift, variance)
        self._advance(dt_s)
        others = np.logical_not(free)
        self._in_contact = (self._in_contact | pressed) & others
        presumed, prior = self._presume(shift, variance, detected & ~self._in_contact, dt_s)
        warmth, warmth_variance = self._warmth(local_kelvin, presumed)
        suspicious = self._judge(shift, variance, detected, presumed, warmth, warmth_variance)
        self._in_contact = (self._in_contact | pressed) & others
        suspicious &= others
        trusted = detected & ~self._in_contact & ~suspicious & (warmth == 0.0)
        self._common = prior
        if trusted.any():
            self._measure(shift, variance, trusted, local_kelvin)
        else:
            self._followed = trusted
        expected, expected_variance = self._expected(self._common, *self._warmth(local_kelvin, self._common))
        theta, reference = self._common.mean
        theta_variance = self._common.covariance[0, 0] + self._start_variance
        return DriftReading(
            float(theta),
            float(np.sqrt(theta_variance)),
            float(reference),
            self._held_s,
            expected,
            np.sqrt(expected_variance),
            self._in_contact.copy(),
        )

    def _detected(self, shift: Floats, variance: Floats) -> Bools:
        detected: Bools = np.isfinite(shift) & (variance > 0) & np.isfinite(variance)
        return detected

    def _advance(self, dt_s: float) -> None:
        mean, covariance = self._common
        self._common = _Common(mean, covariance + dt_s * np.diag([THETA_WALK_KELVIN**2, REFERENCE_WALK**2]))
        self._offsets.variance += dt_s * OFFSET_WALK**2
        self._thermometers.variance += dt_s * THERMOMETER_WALK_KELVIN**2
        self._held_s += dt_s
        self._step_s = dt_s
        trend = max(abs(self._trend_kelvin_per_s) - TREND_FLOOR_KELVIN_PER_S, 0.0)
        self._unrest_kelvin_per_s = max(trend, self._unrest_kelvin_per_s * float(np.exp(-dt_s / UNREST_S)))

    def _presume(self, shift: Floats, variance: Floats, free: Bools, dt_s: float) -> tuple[_Common, _Common]:
        """Return a robust first estimate of theta and g from the free sites, and the prior of a fit around it.

        Where that would take the plate beyond its largest rate, the sites are pressed and the prediction stands.
        """
        mean, covariance = predicted = self._common
        if np.count_nonzero(free) < SITES_MIN:
            return predicted, predicted
        rate_kelvin = RATE_MAX_KELVIN_PER_S * dt_s
        wide = _Common(mean, covariance + np.diag([rate_kelvin**2, 0.0]))
        presumed = self._fit(shift, variance + self._offsets.variance, free, wide, robust=True)
        step_kelvin = float(presumed.mean[0] - mean[0])
        if abs(step_kelvin) > rate_kelvin + OFF_SIGMAS * float(np.sqrt(covariance[0, 0])):
            return predicted, predicted
        return presumed, _Common(mean, covariance + np.diag([step_kelvin**2, 0.0]))

    def _fit(self, shift: Floats, variance: Floats, where: Bools, prior: _Common, *, robust: bool) -> _Common:
        """Fit theta and g to the sites in `where`.

        Gauss-Newton steps, each by QR; `robust` gives large residuals the weight of Huber, Ann. Math. Stat. 35 (1964).
        """
        whitener = _inverse(np.asarray(np.linalg.cholesky(prior.covariance).T)).T
        inverse_std = 1.0 / np.sqrt(variance[where])
        target = shift[where] - self._offsets.mean[where]
        coefficients = self._coefficients[:, where]
        common = prior
        root_weight = np.ones(len(target))
        stacked = np.empty((2 + len(target), 3))
        stacked[:2, :2] = whitener
        for _ in range(FIT_STEPS):
            residual = (target - common.shift(coefficients)) * inverse_std
            stacked[:2, 2] = whitener @ (prior.mean - common.mean)
            stacked[2:, 0] = common.slope(coefficients) * inverse_std * root_weight
            stacked[2:, 1] = inverse_std * root_weight
            stacked[2:, 2] = residual * root_weight
            triangle: Floats = np.asarray(np.linalg.qr(stacked, mode="r"))
            inverse = _inverse(triangle)
            common = _Common(common.mean + inverse @ triangle[:2, 2], inverse @ inverse.T)
            if np.abs(triangle[:2, 2]).max() < FIT_TOLERANCE:
                break
            if robust:
                sigmas = np.abs(target - common.shift(coefficients)) * inverse_std
                root_weight = np.sqrt(HUBER_SIGMAS / np.maximum(sigmas, HUBER_SIGMAS))
        return common

    def _judge(
        self,
        shift: Floats,
        variance: Floats,
        detected: Bools,
        presumed: _Common,
        warmth: Floats,
        warmth_variance: Floats,
    ) -> Bools:
        """Return the sites that a press may have moved, and update which are in contact."""
        expected, expected_variance = self._expected(presumed, warmth, warmth_variance)
        total = np.where(detected, expected_variance + variance, 1.0)
        sigmas = np.where(detected, np.abs(shift - expected) / np.sqrt(total), np.nan)
        suspicious: Bools = sigmas > ON_SIGMAS
        self._above = np.where(detected, (self._above + 1) * suspicious, self._above)
        self._below = np.where(detected, (self._below + 1) * (sigmas < OFF_SIGMAS), self._below)
        held = self._in_contact & (self._below < OFF_FRAMES)
        self._in_contact = held | (self._above >= ON_FRAMES)
        return suspicious

    def _measure(self, shift: Floats, variance: Floats, trusted: Bools, local_kelvin: Floats | None) -> None:
        """Update theta and g from trusted sites, then these sites' offsets and thermometers."""
        before_kelvin = self._common.mean[0]
        self._common = self._fit(shift, variance + self._offsets.variance, trusted, self._common, robust=False)
        theta = self._common.mean[0]
        if self._started and self._held_s > 0:
            rate = (theta - before_kelvin) / self._held_s
            self._rate_kelvin_per_s -= np.expm1(-self._held_s / RATE_MEMORY_S) * (rate - self._rate_kelvin_per_s)
            self._trend_kelvin_per_s -= np.expm1(-self._held_s / TREND_MEMORY_S) * (rate - self._trend_kelvin_per_s)
        self._held_s = 0.0
        if not self._started:
            # From here on errors differ from those of the start, which the offsets compensate.
            self._start_variance = float(self._common.covariance[0, 0])
            self._common = _Common(self._common.mean, np.zeros((2, 2)))
            self._started = True
        self._offsets.variance += np.where(trusted, self._drifted(self._common, np.zeros(len(shift))), 0.0)
        own_variance = variance + self._common.variance(self._common.slope(self._coefficients))
        self._offsets.measure(shift - self._common.shift(self._coefficients), own_variance, trusted)
        self._anchor_kelvin = np.where(trusted, theta, self._anchor_kelvin)
        self._followed = trusted
        if local_kelvin is not None:
            read_variance = self._local_variance + self._common.covariance[0, 0]
            self._thermometers.measure(local_kelvin - theta, read_variance, trusted & np.isfinite(local_kelvin))

    def _warmth(self, local_kelvin: Floats | None, common: _Common) -> tuple[Floats, Floats]:
        """Return how much warmer a site is than the plate, with its variance; 0 without a significant difference."""
        sites = self._coefficients.shape[1]
        if local_kelvin is None:
            return np.zeros(sites), np.zeros(sites)
        known = np.isfinite(local_kelvin) & np.isfinite(self._thermometers.variance)
        own_kelvin = np.where(known, local_kelvin - self._thermometers.mean, 0.0)
        own_variance = np.where(known, self._thermometers.variance + self._local_variance, 0.0)
        free = known & ~self._in_contact
        if np.count_nonzero(free) >= SITES_MIN:  # better than theta, which the reference may have a part in
            plate_kelvin, plate_variance = float(np.median(own_kelvin[free])), 0.0
        else:
            plate_kelvin, plate_variance = float(common.mean[0]), float(common.covariance[0, 0])
        warmth = own_kelvin - plate_kelvin
        variance = own_variance + plate_variance
        significant = known & (self._in_contact | (warmth**2 > OFF_SIGMAS**2 * variance))
        return np.where(significant, warmth, 0.0), np.where(significant, variance, 0.0)

    def _expected(self, common: _Common, warmth: Floats, warmth_variance: Floats) -> tuple[Floats, Floats]:
        slope = common.slope(self._coefficients)
        expected = common.shift(self._coefficients, warmth) + self._offsets.mean
        variance = self._offsets.variance + common.variance(slope) + slope**2 * warmth_variance
        return expected, variance + self._drifted(common, warmth)

    def _drifted(self, common: _Common, warmth: Floats) -> Floats:
        """Variance of a site's shift from its coefficients, for the change of temperature since it was last measured.

        The coefficients of the sites that determine theta are as uncertain and add their share; what an error of theta
        at the start does to all slopes cancels. From frame to frame the change is by the plate's mean rate,
        which the noise of theta would hide.
        """
        _, b, c = self._coefficients
        theta = common.mean[0]
        slope = common.slope(self._coefficients)
        curvature = 2.0 * b + 6.0 * c * theta
        seen_by = np.where(self._in_contact, 0.0, slope)  # theta follows shifts of these, in proportion
        sensitivity = float(seen_by @ seen_by)
        weight = slope / sensitivity if sensitivity > 0.0 else np.zeros(len(slope))
        slope_variance = self._coefficient_variance * (1.0 + weight * slope)
        slope_variance += (curvature - weight * float(seen_by @ curvature)) ** 2 * self._start_variance
        step_kelvin = self._rate_kelvin_per_s * self._step_s
        unrest_kelvin = self._unrest_kelvin_per_s * np.sqrt(self._step_s * TREND_MEMORY_S)
        step_kelvin = np.hypot(step_kelvin, unrest_kelvin)
        change_kelvin = np.where(self._followed, step_kelvin, theta - self._anchor_kelvin) + warmth
        drifted: Floats = slope_variance * change_kelvin**2
        return drifted


def _inverse(triangle: Floats) -> Floats:
    """Inverse of the upper triangle (2, 2) that `triangle` begins with."""
    first, second = 1.0 / triangle[0, 0], 1.0 / triangle[1, 1]
    return np.array([[first, -triangle[0, 1] * first * second], [0.0, second]])
