"""Changes of states in the log: one line each, their level, and the sum of frequent ones."""

import logging

import pytest

from resonator_daemon.base.host.state_log import SINGLE_MAX, STEADY_S, SUM_S, StateLog
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode

LOG = logging.getLogger(__name__)
WELL = (Condition.ONLINE, Reason(ReasonCode.MEASURING, "sites are read"))
SILENT = (Condition.STALLED, Reason(ReasonCode.CHANNELS_SILENT, "channel 0"))


@pytest.mark.parametrize(
    ("condition", "code", "level"),
    [
        (Condition.ONLINE, ReasonCode.MEASURING, logging.INFO),
        (Condition.ONLINE, ReasonCode.NAME_CONFLICT, logging.WARNING),
        (Condition.STARTING, ReasonCode.COMMON_MODE_PENDING, logging.INFO),
        (Condition.WAITING, ReasonCode.NO_FRAMES, logging.INFO),
        (Condition.WAITING, ReasonCode.NO_SUCH_PORT, logging.WARNING),
        (Condition.PRESSED_AT_START, ReasonCode.PRESSED_AT_START, logging.WARNING),
        (Condition.STALLED, ReasonCode.CHANNELS_SILENT, logging.WARNING),
        (Condition.UNCALIBRATED, ReasonCode.UNCALIBRATED, logging.WARNING),
    ],
)
def test_a_change_has_one_line_with_its_code(
    condition: Condition, code: ReasonCode, level: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    states = StateLog("sensor", LOG)
    for text in ("why", "why", "in other words"):
        states.write(condition, Reason(code, text))
    (record,) = caplog.records
    assert (record.levelno, record.message) == (level, f"sensor {condition} ({code}): why")
    assert (vars(record)["resonatord_sensor_state"], vars(record)["resonatord_reason_code"]) == (condition, code)


def test_frequent_changes_are_summed_up_every_20_s_until_a_state_lasts(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    now_s = 0.0
    states = StateLog("sensor", LOG, clock=lambda: now_s)
    for number in range(100):
        states.write(*(SILENT if number % 2 else WELL))
        now_s += 0.5
    assert len(caplog.records) == SINGLE_MAX + 2
    now_s += STEADY_S - 0.5  # since the last change
    states.flush()
    states.flush()
    *_, line = caplog.records[SINGLE_MAX + 2 :]
    assert (len(caplog.records), line.levelno) == (SINGLE_MAX + 3, logging.WARNING)
    assert line.message == "sensor: 14 changes in 10 s; now stalled (channels_silent): channel 0"
    now_s += SUM_S
    states.write(*WELL)
    assert caplog.records[-1].message == "sensor online (measuring): sites are read"
