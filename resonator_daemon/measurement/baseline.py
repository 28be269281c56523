"""The common mode of all tones, reference error and temperature alike: learnt while untouched, held while touched."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from resonator_daemon.measurement.random_walk import FloatArray, RandomWalks

# What the sites' temperature coefficients differ from the pilot's, unknown, over the plate's temperature range.
COMMON_MODE_STD: Final = 2e-7
# A room takes a plate through 2 K in ten minutes, 0.1 K in a second's random walk; a cut near its turnover answers with
# 1e-7 per kelvin, and an ordinary reference clock beside it with less.
COMMON_MODE_WALK: Final = 1e-8  # relative frequency after one second
KNOWN_CHANNELS: Final = 2  # so many tell a site and a force


class CommonMode:
    """Relative frequency error g per channel: a random walk that the untouched tones measure.

    Unknown, channel by channel, until it has been heard untouched in `needed` readings since the start or the last
    `reset`, or was set by `tare`; unknown as a whole until two channels are known. Only a board's boot or a new
    configuration is a reason for `reset`.
    """

    def __init__(self, channels: int, *, needed: int, reading_std: float, floor_std: float = COMMON_MODE_STD) -> None:
        """Take the noise of a reading and what no reading tells, `floor_std`; both relative, one standard deviation."""
        if needed < 1:
            raise ValueError(f"{needed} readings needed, at least 1")
        if not (floor_std >= 0 and math.isfinite(floor_std)):
            raise ValueError(f"floor_std {floor_std} must be finite and not below 0")
        self._needed = needed
        self.expect(reading_std)
        self._floor_variance = floor_std**2
        self._walks = RandomWalks(channels)
        self._count_none(channels)

    def reset(self) -> None:
        self._walks.reset()
        self._count_none(len(self._count))

    def _count_none(self, channels: int) -> None:
        self._count = [0] * channels
        self._learnt = [False] * channels

    def expect(self, reading_std: float) -> None:
        """Take the noise of the readings from here, as of another window; what was learnt stays."""
        if not (reading_std > 0 and math.isfinite(reading_std)):
            raise ValueError(f"reading_std {reading_std} must be finite and above 0")
        self._reading_variance = reading_std**2

    def update(self, readings: Sequence[float], elapsed_s: float) -> None:
        """Take one reading of g per channel, NaN for a channel that was not heard untouched.

        To be called while touched, too, with NaN: `elapsed_s` since the call before makes the held values less certain.
        """
        if not (elapsed_s >= 0 and math.isfinite(elapsed_s)):
            raise ValueError(f"elapsed_s {elapsed_s} must be finite and not below 0")
        self._walks.advance(COMMON_MODE_WALK**2 * elapsed_s)
        self._measure(readings, 1)

    def tare(self, readings: Sequence[float]) -> None:
        """Take the present mean of g per channel for the truth; a NaN leaves its channel as it was."""
        heard = ~np.isnan(self._array(readings))
        self._walks.variance[heard] = math.inf
        self._measure(readings, self._needed)

    def _measure(self, readings: Sequence[float], worth: int) -> None:
        reading = self._array(readings)
        heard = ~np.isnan(reading)
        if not heard.any():
            return
        self._walks.measure(reading, self._reading_variance, heard)
        self._count = [count + worth * int(h) for count, h in zip(self._count, heard, strict=True)]
        self._learnt = [count >= self._needed for count in self._count]

    def _array(self, readings: Sequence[float]) -> FloatArray:
        if len(readings) != len(self._count):
            raise ValueError(f"{len(readings)} readings for {len(self._count)} channels")
        return np.array(readings, dtype=np.float64)

    @property
    def known(self) -> bool:
        return sum(self._learnt) >= min(KNOWN_CHANNELS, len(self._learnt))

    @property
    def value(self) -> tuple[float, ...]:
        """Return g per channel; NaN where and until it is not known."""
        if not self.known:
            return (math.nan,) * len(self._learnt)
        return tuple(g if k else math.nan for g, k in zip(self._walks.mean.tolist(), self._learnt, strict=True))

    @property
    def std(self) -> float:
        """What `value` may be off by, relative, in common on all channels; NaN until known."""
        if not self.known:
            return math.nan
        known = (v for v, k in zip(self._walks.variance.tolist(), self._learnt, strict=True) if k)
        return math.sqrt(max(known) + self._floor_variance)
