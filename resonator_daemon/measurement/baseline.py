"""The common mode of all tones, reference error and temperature alike: learnt while untouched, held while touched."""

import math
from collections.abc import Sequence
from typing import Final

COMMON_MODE_STD: Final = 2e-7  # what the held value may be off by, relative frequency


class CommonMode:
    """Relative frequency error g per channel, as an exponential mean over untouched readings.

    Unknown until every channel has been heard untouched in `needed` readings since the start or the last `reset`; only
    a board's boot or a new configuration is a reason for `reset`.
    """

    def __init__(self, channels: int, *, needed: int, memory: int) -> None:
        """`memory` is the length of the exponential mean, in readings."""
        if not 1 <= needed <= memory:
            raise ValueError(f"{needed} readings needed of a mean over {memory}, at least 1 and at most the mean")
        self._needed = needed
        self._memory = memory
        self._mean = [math.nan] * channels
        self._count = [0] * channels

    def reset(self) -> None:
        self._mean = [math.nan] * len(self._mean)
        self._count = [0] * len(self._count)

    def update(self, readings: Sequence[float]) -> None:
        """Take one untouched reading of g per channel, NaN for a channel that was not heard."""
        for channel, reading in enumerate(readings):
            if math.isnan(reading):
                continue
            count = min(self._count[channel] + 1, self._memory)
            mean = self._mean[channel] if count > 1 else reading
            self._mean[channel] = mean + (reading - mean) / count
            self._count[channel] = count

    @property
    def known(self) -> bool:
        return min(self._count) >= self._needed

    @property
    def value(self) -> tuple[float, ...]:
        """Return g per channel; NaN until known."""
        return tuple(self._mean) if self.known else (math.nan,) * len(self._mean)
