"""The daemon's own state: connections to the broker, and another daemon of the same name."""

import json

import pytest

from resonator_daemon.monitoring.daemon_state import DaemonSnapshot, DaemonState
from resonator_daemon.publishing.mqtt_messages import Incoming
from resonator_daemon.publishing.payloads import Condition
from resonator_daemon.reasons import Reason, ReasonCode

MEASURING = Reason(ReasonCode.MEASURING, "measuring")


def incoming(boot_id: object, state: object, *, retained: bool = False, connected: object = None) -> Incoming:
    payload = json.dumps({"daemon_boot_id": boot_id, "state": state, "connected_t_ns": connected}).encode()
    return Incoming("resonator/hand/state/daemon", payload, retained, None, None)


@pytest.fixture
def said() -> list[DaemonSnapshot]:
    return []


@pytest.fixture
def restored() -> list[None]:
    """Grows when what is retained is published again."""
    return []


@pytest.fixture
def state(said: list[DaemonSnapshot], restored: list[None]) -> DaemonState:
    state = DaemonState("aa", said.append, lambda: restored.append(None))
    state.become(Condition.ONLINE, MEASURING, 5)
    state.connected(1)
    said.clear()
    return state


def test_each_connection_is_numbered_and_dated(state: DaemonState, said: list[DaemonSnapshot]) -> None:
    first = state.snapshot
    state.connected(2)
    (again,) = said
    assert (again.condition, again.reason, again.since_utc_ns) == (Condition.ONLINE, MEASURING, 5)
    assert (first.connections, again.connections) == (1, 2)
    assert first.connected_utc_ns is not None
    assert again.connected_utc_ns is not None
    assert again.connected_utc_ns > first.connected_utc_ns


def test_its_own_will_of_an_earlier_connection_is_answered_unless_it_has_ended(
    state: DaemonState, said: list[DaemonSnapshot]
) -> None:
    state.receive(incoming("aa", "online"))
    assert said == []
    state.receive(incoming("aa", "offline"))
    assert [snapshot.condition for snapshot in said] == [Condition.ONLINE]
    state.end()
    state.receive(incoming("aa", "offline"))
    assert len(said) == 1


def test_strangers_who_claim_to_be_thousands_are_not_listed(state: DaemonState, said: list[DaemonSnapshot]) -> None:
    for number in range(3000):
        state.receive(incoming(f"b{number}", "online"))
    assert len(said) == 4
    assert len(state.snapshot.reason.text) < 400


def test_of_two_daemons_one_answers_for_a_run(state: DaemonState) -> None:
    connected_ns = state.snapshot.connected_utc_ns or 0
    for other, owns in (
        (str(connected_ns + 1), True),
        (str(connected_ns), True),  # of equal times the lower boot id
        (str(connected_ns - 1), False),
        ("9" * 100, True),
        (None, True),
        (-1, True),
        ("-1", True),
    ):
        state.receive(incoming("bb", "online", connected=other))
        answers = [state.answers_for(run) for run in (None, "an earlier one", "aa", "bb")]
        assert answers == [owns, owns, True, False], other
    state.receive(incoming("bb", "online", connected="0"))
    assert not state.answers_for(None)
    state.receive(incoming("bb", "offline"))
    assert state.answers_for(None)
    assert state.answers_for("bb")


def test_the_conflict_is_over_when_the_other_has_gone(
    state: DaemonState, said: list[DaemonSnapshot], restored: list[None]
) -> None:
    state.receive(incoming("bb", "online"))
    state.receive(incoming("cc", "online"))
    state.receive(incoming("bb", "offline"))
    assert "boot id cc)" in said[-1].reason.text
    state.receive(incoming("cc", "offline"))
    assert said[-1].reason == MEASURING
    assert len(said) == 4
    assert len(restored) == 2  # the other had written over everything


def test_retained_states_and_earlier_connections_are_no_conflict(
    state: DaemonState, said: list[DaemonSnapshot]
) -> None:
    state.receive(incoming("bb", "online", retained=True))
    state.receive(incoming("bb", "offline", retained=True))
    assert said == []
    state.receive(incoming("bb", "online"))
    state.connected(2)
    assert said[-1].reason == MEASURING


@pytest.mark.parametrize(
    "payload",
    [b"", b"{}", b"[]", b"7", b"\xff", b'{"daemon_boot_id": "b"}', b"[" * 100_000, b'{"state": "online"}']
    + [
        json.dumps({"daemon_boot_id": boot_id, "state": "online"}).encode()
        for boot_id in (7, None, "", "x" * 65, "a\nb", ["b"], {"b": 1})
    ],
)
def test_garbage_is_passed_over(state: DaemonState, said: list[DaemonSnapshot], payload: bytes) -> None:
    state.receive(Incoming("resonator/hand/state/daemon", payload, False, None, None))
    assert said == []
