"""The sensor's state from the readings' status: conditions that last are announced, those within a touch are not."""

import math
from collections.abc import Callable, Sequence

from resonator_daemon.base.reasons import Reason, ReasonCode, joined
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.estimate.forces.baseline import DriftWatch
from resonator_daemon.estimate.forces.readings import Compensation
from resonator_daemon.measure.sensors.usual_reasons import COMMON_MODE_PENDING, NO_TONE
from resonator_daemon.mqtt.payloads import Condition

_LASTS_NS = 250_000_000  # a touch changes the captured tone and has no reading for one window

_REPEAT_NS = 1_000_000_000  # with the latest compensation

_CONDITIONS = {
    "pressed_at_start": Condition.PRESSED_AT_START,
    "pilot_lost": Condition.STALLED,
    "no_signal": Condition.STALLED,
}


class SensorState:
    """Follows readings and announces each change of condition once, and once a second what is compensated.

    Parameters
    ----------
    announce
        Called with condition, reason, the UTC nanoseconds since when, and the latest compensation, None without one.
    well
        The reason to give while nothing is wrong: what the sensor reads.
    """

    def __init__(self, announce: Callable[[Condition, Reason, int, Compensation | None], None], well: str) -> None:
        self._announce = announce
        self._well = Reason(ReasonCode.MEASURING, well)
        self._good = Condition.ONLINE, self._well
        self._expiry: Reason | None = None
        self._drift = DriftWatch()
        self._current: tuple[Condition, Reason] | None = None
        self._candidate: tuple[Condition, Reason] | None = None
        self._candidate_since_ns = self._candidate_since_utc_ns = self._since_utc_ns = self._last_utc_ns = 0
        self._compensation: Compensation | None = None
        self._repeat_at_ns = 0

    def explain(self, note: Reason | None, condition: Condition = Condition.ONLINE) -> None:
        """Set the condition of a sensor whose frames show nothing wrong, and add to its reason; None takes it back."""
        before = self._best
        self._good = condition, joined(note, self._well) or self._well
        if self._current == before:
            same = condition == before[0]
            self._become(self._best, self._since_utc_ns if same else self._last_utc_ns)

    def calibration(self, expiry: str | None, utc_ns: int) -> None:
        """Set why the calibration no longer holds, None while it does. To be repeated: it comes with time."""
        reason = Reason(ReasonCode.UNCALIBRATED, expiry) if expiry is not None else None
        if reason != self._expiry:
            before, self._expiry = self._best, reason
            if self._current == before:
                self._become(self._best, utc_ns)

    @property
    def _best(self) -> tuple[Condition, Reason]:
        """The state of a sensor whose frames show nothing wrong."""
        condition, _ = self._good
        return (Condition.UNCALIBRATED, self._expiry) if self._expiry and condition == Condition.ONLINE else self._good

    def no_frames(self, reason: Reason, utc_ns: int) -> None:
        """Set the state to waiting: no frames come."""
        self._last_utc_ns = utc_ns
        waiting = self._current is not None and self._current[0] is Condition.WAITING
        self._become((Condition.WAITING, reason), self._since_utc_ns if waiting else utc_ns)

    def update(
        self,
        status: str,
        reason: Reason | None,
        common_mode: Sequence[float],
        at: Instant,
        compensation: Compensation | None = None,
    ) -> None:
        """Update with one reading's status and baseline; a first condition is announced at once."""
        utc_ns, now_ns = at.utc_ns, at.boottime_ns  # durations do not depend on the wall clock
        self._compensation, self._last_utc_ns = compensation, utc_ns
        plate_kelvin = compensation.plate_kelvin if compensation is not None else math.nan
        known = not all(map(math.isnan, common_mode))
        drift = self._drift.update(common_mode, plate_kelvin, now_ns * 1e-9)
        if (condition := _CONDITIONS.get(status)) is not None:
            seen = condition, reason or NO_TONE
        elif drift is not None:
            seen = Condition.DRIFTING, drift
        else:
            seen = self._best if known else (Condition.STARTING, reason or COMMON_MODE_PENDING)
        condition, _ = seen
        if self._current is not None and condition == self._current[0]:
            self._candidate = None
            if seen == self._best:
                self._become(seen, self._since_utc_ns)
            if compensation is not None and now_ns >= self._repeat_at_ns:
                self._repeat_at_ns = now_ns + _REPEAT_NS
                self._announce(*self._current, self._since_utc_ns, compensation)
            return
        if self._candidate is None or self._candidate[0] != condition:
            self._candidate, self._candidate_since_ns = seen, now_ns
            self._candidate_since_utc_ns = utc_ns
        waited = self._current is None or self._current[0] in (Condition.WAITING, Condition.STARTING)
        if waited or now_ns - self._candidate_since_ns >= _LASTS_NS:
            self._become(seen, self._candidate_since_utc_ns)

    def _become(self, state: tuple[Condition, Reason], since_utc_ns: int) -> None:
        if state != self._current:
            self._current, self._candidate = state, None
            self._since_utc_ns = since_utc_ns
            self._announce(*state, since_utc_ns, self._compensation)
