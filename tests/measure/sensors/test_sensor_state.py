"""The sensor's state: which word a reading earns, at once or only when it lasts, and since when."""

import math
from typing import get_args

import pytest

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.estimate.forces.readings import Compensation, SensorStatus
from resonator_daemon.measure.sensors.output import SensorState
from resonator_daemon.mqtt.payloads import Condition

T0_NS = 1_789_000_000_000_000_123
MS = 1_000_000
ESTIMATED, UNKNOWN = (0.0, 1e-6, -2e-6, 0.0), (math.nan,) * 4


def stated(text: str) -> Reason | None:
    return Reason(ReasonCode.CHANNELS_SILENT, text) if text else None


def instant(at_ms: float, set_ms: float) -> Instant:
    """Return a moment by a wall clock that was set by so much."""
    return Instant(T0_NS + round((at_ms + set_ms) * MS), 0, 0, boottime_ns=round(at_ms * MS))


class Sensor:
    """A sensor's state that is fed readings by milliseconds, and what it has announced."""

    def __init__(self) -> None:
        self.said: list[tuple[Condition, str, int]] = []
        self.codes: list[ReasonCode] = []
        self.state = SensorState(self._announce, "sites are read")

    def _announce(self, condition: Condition, reason: Reason, since_ns: int, _: object) -> None:
        self.codes.append(reason.code)
        self.said.append((condition, reason.text, since_ns))

    def read(
        self, at_ms: float, status: str, reason: str = "", common_mode: tuple[float, ...] = ESTIMATED, set_ms: float = 0
    ) -> list[Condition]:
        """Feed one reading; return the conditions that were announced for it."""
        before = len(self.said)
        self.state.update(status, stated(reason), common_mode, instant(at_ms, set_ms))
        return [condition for condition, _, _ in self.said[before:]]


@pytest.fixture
def sensor() -> Sensor:
    """Return a sensor that was found well at 0 ms, and has said so."""
    sensor = Sensor()
    assert sensor.read(0, "ok") == [Condition.ONLINE]
    return sensor


def test_a_calibration_that_expires_is_reported_once_and_hides_nothing_worse(sensor: Sensor) -> None:
    for _ in range(3):
        sensor.state.calibration("c1 expired", T0_NS)
    assert [(condition, reason) for condition, reason, _ in sensor.said[1:]] == [(Condition.UNCALIBRATED, "c1 expired")]
    sensor.state.explain(stated("site 7"))
    assert sensor.said[-1][:2] == (Condition.UNCALIBRATED, "site 7; c1 expired")
    assert sensor.codes[-1] == ReasonCode.CHANNELS_SILENT
    sensor.state.explain(None)
    assert {since for condition, _, since in sensor.said if condition is Condition.UNCALIBRATED} == {T0_NS}
    for at_ms in (5, 10, 300):
        sensor.read(at_ms, "no_signal")
    assert sensor.said[-1][0] is Condition.STALLED
    sensor.read(400, "ok")
    assert sensor.read(700, "ok") == [Condition.UNCALIBRATED]
    sensor.state.calibration(None, T0_NS)
    assert sensor.said[-1][:2] == (Condition.ONLINE, "sites are read")


@pytest.mark.parametrize(
    ("status", "common_mode", "condition"),
    [
        ("settling", UNKNOWN, Condition.STARTING),
        ("settling", (math.nan,), Condition.STARTING),
        ("pressed_at_start", UNKNOWN, Condition.PRESSED_AT_START),
        ("pilot_lost", UNKNOWN, Condition.STALLED),
        ("no_signal", UNKNOWN, Condition.STALLED),
    ],
)
def test_the_first_judgement_counts_at_once(status: str, common_mode: tuple[float, ...], condition: Condition) -> None:
    sensor = Sensor()
    sensor.read(7, status, "why", common_mode)
    assert sensor.said == [(condition, "why", T0_NS + 7 * MS)]


@pytest.mark.parametrize(
    "status", sorted(set(get_args(SensorStatus)) - {"pressed_at_start", "pilot_lost", "no_signal"})
)
def test_what_a_touch_can_do_to_a_reading_is_no_trouble_of_the_sensor(sensor: Sensor, status: str) -> None:
    for at_ms in range(5, 2000, 5):
        assert sensor.read(at_ms, status, "the touch's own reason") == []


def test_trouble_that_lasts_is_reported_with_its_newest_reason_since_its_first_reading(sensor: Sensor) -> None:
    sensor.read(100, "no_signal", "channel 0: no signal")
    sensor.read(349.999999, "no_signal", "channel 0: no signal")
    sensor.read(350, "pilot_lost", "channel 1: no signal")  # another status, the same condition
    sensor.read(900, "no_signal", "channel 2: no signal")
    assert sensor.said[1:] == [(Condition.STALLED, "channel 1: no signal", T0_NS + 100 * MS)]


def test_each_trouble_must_last_by_itself(sensor: Sensor) -> None:
    sensor.read(100, "no_signal")
    sensor.read(300, "pressed_at_start", "touched", UNKNOWN)
    assert sensor.read(400, "pressed_at_start", "touched", UNKNOWN) == []
    assert sensor.read(550, "pressed_at_start", "touched", UNKNOWN) == [Condition.PRESSED_AT_START]
    assert sensor.said[-1][2] == T0_NS + 300 * MS


def test_recovery_must_last_too(sensor: Sensor) -> None:
    sensor.read(100, "no_signal")
    sensor.read(400, "no_signal")
    assert sensor.read(500, "ok") == []
    assert sensor.read(749, "ok") == []
    assert sensor.read(750, "ok") == [Condition.ONLINE]
    assert sensor.said[-1][2] == T0_NS + 500 * MS


@pytest.mark.parametrize(
    ("status", "condition"), [("ok", Condition.ONLINE), ("pressed_at_start", Condition.PRESSED_AT_START)]
)
def test_the_first_reading_after_an_outage_counts_at_once(sensor: Sensor, status: str, condition: Condition) -> None:
    sensor.state.no_frames(Reason(ReasonCode.NO_FRAMES, "link lost"), T0_NS)
    assert sensor.read(10_000, status, "why") == [condition]
    assert sensor.said[-1][2] == T0_NS + 10_000 * MS


def test_trouble_before_an_outage_does_not_count_after_it(sensor: Sensor) -> None:
    sensor.read(100, "no_signal")
    sensor.state.no_frames(Reason(ReasonCode.NO_FRAMES, "link lost"), T0_NS)
    assert sensor.read(5000, "ok") == [Condition.ONLINE]
    assert sensor.read(5005, "no_signal") == []
    assert sensor.read(5255, "no_signal") == [Condition.STALLED]
    assert sensor.said[-1][2] == T0_NS + 5005 * MS


def test_an_explanation_is_added_to_the_reason_of_a_well_sensor_and_taken_back() -> None:
    sensor = Sensor()
    sensor.read(0, "ok")
    for note in ("", "step 1", "step 2", "step 2", ""):
        sensor.state.explain(stated(note))
    plain = sensor.said[0][1]
    assert [reason for _, reason, _ in sensor.said[1:]] == [f"step 1; {plain}", f"step 2; {plain}", plain]
    assert sensor.codes[-3:] == [ReasonCode.CHANNELS_SILENT, ReasonCode.CHANNELS_SILENT, ReasonCode.MEASURING]
    assert {(condition, since) for condition, _, since in sensor.said} == {(Condition.ONLINE, T0_NS)}


def test_an_explanation_may_have_another_condition_that_begins_with_the_last_reading() -> None:
    sensor = Sensor()
    sensor.state.explain(stated("decoder starts"), Condition.STARTING)
    sensor.read(0, "settling", common_mode=UNKNOWN)
    sensor.read(5, "ok")
    assert [condition for condition, _, _ in sensor.said] == [Condition.STARTING, Condition.STARTING]
    assert sensor.codes[-1] == ReasonCode.CHANNELS_SILENT
    for at_ms, condition in ((10, Condition.ONLINE), (20, Condition.STALLED), (30, Condition.STARTING)):
        sensor.read(at_ms, "ok")
        sensor.state.explain(stated("another"), condition)
        assert sensor.read(at_ms + 5, "ok") == []
        assert sensor.said[-1][::2] == (condition, T0_NS + at_ms * MS)


def test_an_explanation_waits_until_the_sensor_is_well() -> None:
    sensor = Sensor()
    sensor.state.explain(stated("before anything was judged"))
    sensor.read(0, "no_signal", "nothing is heard")
    sensor.state.explain(stated("decoding is off"))
    assert [condition for condition, _, _ in sensor.said] == [Condition.STALLED]
    sensor.read(100, "ok")
    sensor.state.explain(stated("decoding is on"))  # between the first good reading and the announcement
    assert sensor.read(350, "ok") == [Condition.ONLINE]
    assert sensor.said[-1][1].startswith("decoding is on; ")
    assert "off" not in sensor.said[-1][1]
    assert "judged" not in sensor.said[-1][1]


def drifting(sensor: Sensor, from_ms: int, until_ms: int) -> None:
    for at_ms in range(from_ms, until_ms, 100):
        sensor.read(at_ms, "ok", common_mode=(1e-10 * at_ms, 0.0, 0.0, 0.0))


def test_a_baseline_that_runs_away_is_drifting_and_its_readings_go_on(sensor: Sensor) -> None:
    drifting(sensor, 100, 8000)
    (_, (condition, reason, since_ns)) = sensor.said
    assert condition is Condition.DRIFTING
    assert "ppm" in reason
    assert 5000 * MS <= since_ns - T0_NS <= 6000 * MS


def test_durations_do_not_depend_on_the_wall_clock(sensor: Sensor) -> None:
    repeats: list[Compensation | None] = []
    state = SensorState(lambda *announced: repeats.append(announced[3]), "sites are read")
    compensation = Compensation(ESTIMATED, 1e-8, "followed", math.nan, math.nan, "off")
    for second, set_ms in enumerate((0, 0, -3_600_000, -3_600_000)):
        state.update("ok", None, ESTIMATED, instant(1000 * second, set_ms), compensation)
    assert repeats == [compensation] * 4
    sensor.read(10, "pilot_lost")
    assert sensor.read(270, "pilot_lost", set_ms=-3_600_000) == [Condition.STALLED]
