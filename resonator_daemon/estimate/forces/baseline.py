"""Common mode of all tones, from reference and temperature: estimated while untouched, held while touched.

A common mode that drifts faster than that of a plate at rest in a room is detected and reported. The noise of the
pilot's oscillator is measured at rest, too.
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import compress
from typing import Final

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.tones.frequency_estimators import OMEGA_WHITE_FM, OSCILLATOR_STD_1S

# What the sites' temperature coefficients differ from the pilot's, unknown, over the plate's temperature range.
COMMON_MODE_STD: Final = 2e-7
# In a room, the temperature of a plate changes by 2 K in ten minutes: a random walk of 0.1 K in a second. A cut near
# its turnover shifts by 1e-7 per kelvin, and an ordinary reference clock next to it by less.
COMMON_MODE_WALK: Final = 1e-8  # relative frequency after one second
KNOWN_CHANNELS: Final = 2  # the least that determine a site and a force

_NOISE_TIME_S: Final = 4.0  # of averaging: 400 windows of 10 ms leave 4 % of a standard deviation
_OUTLIER: Final = 25.0  # limit of one window's variance, as a multiple of the expected one
_UNUSUAL: Final = 1.25  # times the usual noise, from where on the measured one is used

SPAN_S: Final = 10.0
WALKS: Final = 5.0  # standard deviations of the random walk over the span: never in months of a quiet room
_LEAST_S = 5.0  # over shorter spans, the noise of the readings dominates
_EVERY_S = 0.5
_SHIFT_PER_KELVIN = 1e-7  # of a cut near its turnover: the baseline's walk is made of as much
_OVER = 0.5  # of the limit, below which it counts as at rest again


class CommonMode:
    """Relative frequency error g per channel: a random walk that the untouched tones measure.

    Unknown, channel by channel, until it has been received untouched in `needed` readings since the start or the last
    `reset`, or was set by `tare`; unknown as a whole until two channels are known. Only a board's boot or a new
    configuration is a reason for `reset`.

    Attributes
    ----------
    known
        Whether two channels at least are known; of a single one, whether it is.
    value
        g per channel; NaN where and until it is not known.
    """

    def __init__(self, channels: int, *, needed: int, reading_std: float) -> None:
        """Initialise with the noise of a reading, relative, one sigma."""
        self._needed = needed
        self.expect(reading_std)
        self._channels = channels
        self.reset()

    def reset(self) -> None:
        self._mean = [0.0] * self._channels
        self._variance = [math.inf] * self._channels  # of one that was never measured
        self._count = [0] * self._channels
        self._settled = [False] * self._channels
        self.known = False
        self.value: tuple[float, ...] = (math.nan,) * self._channels

    def expect(self, reading_std: float) -> None:
        """Set the noise of further readings, as after a change of the window; estimates stay."""
        self._reading_variance = reading_std**2

    def update(self, readings: Sequence[float], elapsed_s: float) -> None:
        """Update with one reading of g per channel, NaN for a channel not received untouched.

        To be called while touched, too, with NaN: `elapsed_s` since the call before makes the held values less certain.
        """
        step_variance = COMMON_MODE_WALK**2 * elapsed_s
        self._variance = [variance + step_variance for variance in self._variance]
        self._measure(readings, 1)

    def tare(self, readings: Sequence[float]) -> None:
        """Set g per channel to the present mean; NaN leaves a channel unchanged."""
        self._variance = [
            variance if math.isnan(g) else math.inf for variance, g in zip(self._variance, readings, strict=True)
        ]
        self._measure(readings, self._needed)

    def _measure(self, readings: Sequence[float], count: int) -> None:
        # A scalar Kalman filter for each channel, in plain floats: arrays of four numbers take ten times as long.
        if all(map(math.isnan, readings)):
            return
        for channel, g in enumerate(readings):
            if math.isnan(g):
                continue
            before = self._variance[channel]
            gain = before / (before + self._reading_variance) if before < math.inf else 1.0
            self._mean[channel] += gain * (g - self._mean[channel])
            self._variance[channel] = gain * self._reading_variance
            self._count[channel] += count
            self._settled[channel] = self._count[channel] >= self._needed
        self.known = sum(self._settled) >= min(KNOWN_CHANNELS, self._channels)
        if self.known:
            self.value = tuple([g if k else math.nan for g, k in zip(self._mean, self._settled, strict=True)])

    @property
    def std(self) -> float:
        """Return the relative error of `value`, common to all channels; NaN until known."""
        if not self.known:
            return math.nan
        return math.sqrt(max(compress(self._variance, self._settled)) + COMMON_MODE_STD**2)


class OscillatorNoise:
    """Estimator of the white frequency noise of the pilot's oscillator, from adjacent windows of the untouched plate.

    Attributes
    ----------
    std_1s
        Allan deviation at 1 s: the usual one, until a much larger one is measured.
    """

    def __init__(self) -> None:
        self.std_1s = OSCILLATOR_STD_1S
        self._variance = OSCILLATOR_STD_1S**2
        self._end_s, self._windows = math.nan, list[float]()  # end of the last one, and frequencies

    def update(self, time_s: float, relative_frequency: float, counter_variance: float, window_s: float) -> None:
        """Update with the mean frequency of the channels over a window, and the counter's variance of it, relative."""
        since_last_s = time_s - self._end_s
        if since_last_s < 0.99 * window_s:
            return  # they overlap
        is_next = since_last_s < 1.5 * window_s
        self._windows = [*self._windows[-2:], relative_frequency] if is_next else [relative_frequency]
        self._end_s = time_s
        if len(self._windows) == 3:  # whose second difference has no drift
            first, middle, last = self._windows
            of_window = OMEGA_WHITE_FM / window_s
            most = _OUTLIER * (max(self._variance, OSCILLATOR_STD_1S**2) * of_window + counter_variance)
            found = (min((first - 2.0 * middle + last) ** 2 / 6.0, most) - counter_variance) / of_window
            self._variance = max(self._variance + window_s / _NOISE_TIME_S * (found - self._variance), 0.0)
            measured = math.sqrt(self._variance)
            self.std_1s = measured if measured > _UNUSUAL * OSCILLATOR_STD_1S else OSCILLATOR_STD_1S


class DriftWatch:
    """Detector that compares the common mode with that of ten seconds ago.

    The baseline is a random walk of 1e-8 in a second (relative frequency); a plate whose common mode moves by more than
    five standard deviations of that is warmed or cooled, or its reference drifts. What is followed so fast lags
    behind, and what is held under a touch is soon off by more than is stated. A common mode that does not change is one
    that is held: it carries no information, and the time until it is measured again is granted to the walk.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, tuple[float, ...]]] = deque()
        self._verdict: Reason | None = None

    def reset(self) -> None:
        self._seen.clear()
        self._verdict = None

    def update(self, common_mode: Sequence[float], plate_kelvin: float, time_s: float) -> Reason | None:
        """Update with the common mode per channel and the plate's temperature, each NaN where unknown.

        Returns how the baseline drifts, None while it does not.
        """
        values = (*common_mode, _SHIFT_PER_KELVIN * plate_kelvin)
        if all(map(math.isnan, values)):
            self.reset()
            return None
        if self._seen and 0 <= time_s - self._seen[-1][0] < _EVERY_S:
            return self._verdict
        if self._seen:
            last_s, last = self._seen[-1]
            if time_s < last_s:
                self.reset()
            else:
                for now, then in zip(values, last, strict=True):
                    if now != then and not (math.isnan(now) and math.isnan(then)):
                        break
                else:
                    return self._verdict
        self._seen.append((time_s, values))
        while len(self._seen) > 2 and time_s - self._seen[1][0] >= SPAN_S:
            self._seen.popleft()
        self._judge()
        return self._verdict

    def _judge(self) -> None:
        (first_s, first), (last_s, last) = self._seen[0], self._seen[-1]
        moved = [abs(now - then) for now, then in zip(last, first, strict=True) if not math.isnan(now - then)]
        if last_s - first_s < _LEAST_S or not moved:
            return
        most, span_s = max(moved), last_s - first_s
        limit = WALKS * COMMON_MODE_WALK * math.sqrt(span_s)
        if most <= limit * (1.0 if self._verdict is None else _OVER):
            self._verdict = None
            return
        self._verdict = Reason(
            ReasonCode.DRIFTING,
            f"the baseline moves by {most / span_s * 1e6:.2g} ppm/s, {most * 1e6:.2g} ppm in {span_s:.0f} s, where "
            f"at most {limit * 1e6:.2g} ppm are explained: the plate is warmed or cooled, or its reference wanders",
        )
