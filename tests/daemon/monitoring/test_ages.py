"""Ages in the status: right before and after the wall clock is set, and never those of anything before the start."""

import time
from typing import Any

import pytest
import status_samples

from resonator_daemon.daemon.monitoring.status import Status, StatusMonitor
from resonator_daemon.mqtt.payloads import Condition

S = 1_000_000_000
IN_1970_NS = 60 * S


class Clocks:
    """Both clocks as the test wants them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.monotonic_s, self.utc_ns = 5000.0, IN_1970_NS
        monkeypatch.setattr(time, "monotonic", lambda: self.monotonic_s)
        monkeypatch.setattr(time, "time_ns", lambda: self.utc_ns)

    def pass_s(self, seconds: float) -> None:
        self.monotonic_s += seconds
        self.utc_ns += round(seconds * S)


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    return Clocks(monkeypatch)


def status_at(since_ns: int, **changed: Any) -> Status:
    """A status whose moments are all the same."""
    sample = status_samples.status()
    state = status_samples.state(Condition.ONLINE).model_copy(update={"since_t_ns": since_ns})
    moments = {
        "config": sample.config.model_copy(update={"loaded_t_ns": since_ns}),
        "daemon": state.model_copy(update={"connected_t_ns": since_ns}),
        "link": state.model_copy(
            update={"last_outage": status_samples.outage().model_copy(update={"end_t_ns": since_ns})}
        ),
        "sensor": state,
        "recording": sample.recording.model_copy(update={"since_t_ns": since_ns}),
    }
    return sample.model_copy(update=moments | changed)


def ages_of(monitor: StatusMonitor, status: Status) -> dict[str, float]:
    return monitor.with_ages(status).ages_s


NAMES = {"started", "config", "daemon", "link", "sensor", "outage", "connected", "recording"}


@pytest.mark.parametrize("set_to_ns", [status_samples.NOW_NS, 0, IN_1970_NS + 3600 * S, None])
def test_a_wall_clock_that_is_set_changes_no_age(clocks: Clocks, set_to_ns: int | None) -> None:
    monitor, status = StatusMonitor(), status_at(clocks.utc_ns)
    clocks.pass_s(0.75)
    assert ages_of(monitor, status) == pytest.approx(dict.fromkeys(NAMES, 0.75))
    if set_to_ns is not None:
        clocks.utc_ns = set_to_ns
    clocks.pass_s(120.0)
    assert ages_of(monitor, status) == pytest.approx(dict.fromkeys(NAMES, 120.75))


@pytest.mark.parametrize("moment_ns", [status_samples.NOW_NS, 0])
def test_a_moment_by_another_clock_than_now_counts_from_when_it_is_seen(clocks: Clocks, moment_ns: int) -> None:
    monitor = StatusMonitor()
    clocks.pass_s(100.0)
    clocks.utc_ns = status_samples.NOW_NS - 3600 * S
    assert ages_of(monitor, status_at(moment_ns)) == pytest.approx(dict.fromkeys(NAMES, 0.0) | {"started": 100.0})
    clocks.pass_s(2.0)
    assert ages_of(monitor, status_at(moment_ns)) == pytest.approx(dict.fromkeys(NAMES, 2.0) | {"started": 102.0})


def test_a_state_since_the_start_is_as_old_as_the_daemon_however_late_it_is_seen(clocks: Clocks) -> None:
    monitor, started_ns = StatusMonitor(), clocks.utc_ns
    clocks.pass_s(300)
    found = ages_of(monitor, status_at(clocks.utc_ns, started_t_ns=started_ns, daemon=status_at(started_ns).daemon))
    assert (found["started"], found["daemon"], found["link"]) == pytest.approx((300, 300, 0))


def test_a_new_moment_begins_anew_and_nothing_is_older_than_the_daemon(clocks: Clocks) -> None:
    monitor = StatusMonitor()
    clocks.pass_s(3.0)
    assert set(ages_of(monitor, status_at(clocks.utc_ns - 9 * S)).values()) == {3.0}
    clocks.pass_s(50.0)
    later = status_at(clocks.utc_ns - S // 2, sensor=None)
    assert ages_of(monitor, later) == pytest.approx(dict.fromkeys(NAMES - {"sensor"}, 0.5) | {"started": 53.0})
