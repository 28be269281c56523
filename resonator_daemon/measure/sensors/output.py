"""Output of a sensor: headers, lateness and latency of its messages, its state, and the reasons that sensors share."""

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from datetime import date
from time import monotonic_ns
from typing import Any, Final, TypedDict

from resonator_daemon.base.reasons import Reason, ReasonCode, joined
from resonator_daemon.board.config import Config
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.estimate.forces.baseline import DriftWatch
from resonator_daemon.estimate.forces.readings import Compensation, ForceReading, SkinReading
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.payloads import Condition, LatencyInfo, Message
from resonator_daemon.mqtt.topics import HeaderFields, Headers, Topic

DAY_NS: Final = 86_400 * 10**9
_EPOCH_DAY: Final = date(1970, 1, 1).toordinal()


def utc_day(utc_ns: int) -> date:
    """Return the day of a moment, in UTC."""
    return date.fromordinal(_EPOCH_DAY + utc_ns // DAY_NS)


BOARD_RESTARTED: Final = Reason(ReasonCode.BOARD_RESTARTED, "the board restarted")
COMMON_MODE_PENDING: Final = Reason(ReasonCode.COMMON_MODE_PENDING, "the common mode is being estimated")
NO_TONE: Final = Reason(ReasonCode.NO_TONE, "no tone is known")


class ReasonFields(TypedDict):
    """The fields of a reason."""

    reason_code: ReasonCode | None
    reason: str | None


def reason_fields(reason: Reason | None) -> ReasonFields:
    """Return the fields of a reason, which None leaves out."""
    return ReasonFields(reason_code=reason.code if reason else None, reason=reason.text if reason else None)


# About three to an octave where a machine that keeps up is; limits of docs/explanation/performance.md are among them.
BOUNDS_MS: Final = (
    *(0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.0, 6.0, 8.0, 10.0, 14.0, 20.0, 25.0, 35.0, 50.0),
    *(70.0, 100.0, 200.0, 500.0, 1000.0),
)


class LatencyHistogram:
    """Counts durations by magnitude; a bin has all up to its bound, and its bound."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_MS) + 1)

    def add(self, seconds: float) -> None:
        self._counts[bisect_left(BOUNDS_MS, 1e3 * seconds)] += 1

    def info(self) -> LatencyInfo:
        return LatencyInfo(bounds_ms=BOUNDS_MS, counts=tuple(self._counts))


class Latencies:
    """One histogram for each topic of a board whose gates are `gate_s` long."""

    def __init__(self, gate_s: float) -> None:
        self._half_a_gate_ns = round(gate_s / 2 * 1e9)
        self._histograms: dict[str, LatencyHistogram] = {}

    def count(self, topic: Topic[Any], gate_middle: Instant) -> None:
        """Count a message that goes to the publisher now; `gate_middle` is that of the last gate of its window."""
        waited_ns = monotonic_ns() - (gate_middle.monotonic_ns + self._half_a_gate_ns)
        histogram = self._histograms.get(topic.path)
        if histogram is None:
            histogram = self._histograms[topic.path] = LatencyHistogram()
        histogram.add(waited_ns * 1e-9)

    def info(self) -> dict[str, LatencyInfo]:
        """Return the histograms by topic, as `health` publishes them."""
        return {path: histogram.info() for path, histogram in self._histograms.items()}


Publish = Callable[[Topic[Any], Any], None]

_NS: Final = 1_000_000_000


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
        self._note: Reason | None = None
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
        self._good, self._note = (condition, joined(note, self._well) or self._well), note
        if self._current == before:
            same = self._best[0] == before[0]
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
        if self._expiry is None or self._good[0] != Condition.ONLINE:
            return self._good
        return Condition.UNCALIBRATED, joined(self._note, self._expiry) or self._expiry

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


class MessageOutput:
    """Publishes the messages of one sensor.

    Parameters
    ----------
    config
    headers
        Makes the headers.
    state
        State of the sensor, which follows its readings.
    publish
        Called with topic and message.
    is_late
        Returns whether a message about a window that ends at this instant is too late to be published.

    Attributes
    ----------
    latencies
        Histograms of the messages with results.
    skipped_late
        Number of messages that were skipped because they were late.
    """

    def __init__(
        self, config: Config, headers: Headers, state: SensorState, publish: Publish, is_late: Callable[[Instant], bool]
    ) -> None:
        self.headers = headers
        self.state = state
        self.is_late = is_late
        self.publish = publish
        self.skipped_late = 0
        self.latencies = Latencies(1 / config.plate.counter.frame_rate_hz)
        self._gate_s = 1 / config.plate.counter.frame_rate_hz
        self._is_live = config.link.recording_path is None  # a recording has the clock of its time

    def publish_result(self, topic: Topic[Any], message: Message | Encoded, gate_middle: Instant) -> None:
        """Publish a message with a result; record its latency."""
        if self._is_live:
            self.latencies.count(topic, gate_middle)
        self.publish(topic, message)

    def skip(self, *topics: Topic[Any]) -> None:
        """Skip a message of each topic because it would be late."""
        self.headers.skip(*topics)
        self.skipped_late += len(topics)

    def window(self, reading: ForceReading | SkinReading, gate_middle: Instant) -> HeaderFields:
        """Return the header of all messages about a reading whose last gate has this middle, without `seq`."""
        t_ns = gate_middle.utc_ns - round((reading.window_s - self._gate_s) * _NS / 2)
        return self.headers.of_window(t_ns, gate_middle.uncertainty_ns, reading.board_ticks)
