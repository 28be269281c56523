"""Detection of a common mode that drifts faster than a plate at rest in a room."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Final

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.forces.baseline import COMMON_MODE_WALK

SPAN_S: Final = 10.0
WALKS: Final = 5.0  # standard deviations of the random walk over the span: never in months of a quiet room
_LEAST_S = 5.0  # below that, what is seen is the noise of the readings
_EVERY_S = 0.5
_SHIFT_PER_KELVIN = 1e-7  # of a cut near its turnover: the baseline's walk is made of as much
_OVER = 0.5  # of the limit, below which it counts as at rest again


class DriftWatch:
    """Detector that compares the common mode with that of ten seconds ago.

    The baseline is a random walk of 1e-8 in a second (relative frequency); a plate whose common mode moves by more than
    five standard deviations of that is warmed or cooled, or its reference drifts. What is followed so fast lags
    behind, and what is held under a touch is soon off by more than is stated. A common mode that does not change is one
    that is held: it carries no information, and the time until it is measured again is granted to the walk.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, tuple[float, ...]]] = deque()
        self._drifting = False

    def reset(self) -> None:
        self._seen.clear()
        self._drifting = False

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
            elif all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(values, last, strict=True)):
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
        self._moved, self._span_s = max(moved), last_s - first_s
        self._limit = WALKS * COMMON_MODE_WALK * math.sqrt(self._span_s)
        self._drifting = self._moved > self._limit * (_OVER if self._drifting else 1.0)

    @property
    def _verdict(self) -> Reason | None:
        if not self._drifting:
            return None
        rate = self._moved / self._span_s
        return Reason(
            ReasonCode.DRIFTING,
            f"the baseline moves by {rate * 1e6:.2g} ppm/s, {self._moved * 1e6:.2g} ppm in {self._span_s:.0f} s, where "
            f"at most {self._limit * 1e6:.2g} ppm are explained: the plate is warmed or cooled, or its reference "
            "wanders",
        )
