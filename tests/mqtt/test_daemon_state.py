"""State of the daemon: connections to the broker, and conflicts with daemons of the same name."""

import json
from collections.abc import AsyncIterator

import pytest
from observer import skipping

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.daemon_state import RESTORE_S, SILENT_S, DaemonSnapshot, DaemonState
from resonator_daemon.mqtt.payloads import Condition

MEASURING = Reason(ReasonCode.MEASURING, "measuring")


def incoming(boot_id: str, state: str = "online", *, retained: bool = False) -> Incoming:
    content = {"daemon_boot_id": boot_id, "state": state, "t_ns": "1"}
    return Incoming("resonator/hand/state/daemon", json.dumps(content).encode(), retained, None, None)


@pytest.fixture
def sent() -> list[DaemonSnapshot]:
    return []


@pytest.fixture
def restored() -> list[None]:
    """One element for each restoration of the retained topics."""
    return []


@pytest.fixture
async def state(sent: list[DaemonSnapshot], restored: list[None]) -> AsyncIterator[DaemonState]:
    state = DaemonState("aa", sent.append, lambda: restored.append(None))
    state.become(Condition.ONLINE, MEASURING, 5)
    state.connected(1)
    sent.clear()
    yield state
    state.end()


def reason_code(state: DaemonState) -> ReasonCode:
    return state.snapshot.reason.code


async def test_each_connection_is_numbered_and_dated(state: DaemonState, sent: list[DaemonSnapshot]) -> None:
    first = state.snapshot
    state.connected(2)
    (again,) = sent
    assert (again.condition, again.reason, again.since_utc_ns) == (Condition.ONLINE, MEASURING, 5)
    assert (first.connections, again.connections) == (1, 2)
    assert first.connected_utc_ns is not None
    assert again.connected_utc_ns is not None
    assert again.connected_utc_ns > first.connected_utc_ns
    state.end()
    state.receive(incoming("bb"))
    assert sent == [again]


async def test_another_daemon_is_a_conflict_unless_its_message_is_old(state: DaemonState) -> None:
    state.receive(incoming("bb", retained=True))
    state.receive(incoming("aa"))
    assert (reason_code(state), state.answers_for("bb")) == (ReasonCode.MEASURING, True)
    state.receive(incoming("bb"))
    assert reason_code(state) is ReasonCode.NAME_CONFLICT
    state.connected(2)
    assert reason_code(state) is ReasonCode.MEASURING


async def test_thousands_of_forged_boot_ids_are_not_listed(state: DaemonState, sent: list[DaemonSnapshot]) -> None:
    for number in range(3000):
        state.receive(incoming(f"b{number}"))
    assert len(state.snapshot.reason.text) < 400
    assert len(sent) == 2


async def test_a_daemon_answers_for_all_runs_but_those_of_others(state: DaemonState) -> None:
    state.receive(incoming("bb"))
    assert [state.answers_for(run) for run in (None, "an earlier one", "aa", "bb")] == [True, True, True, False]
    state.receive(incoming("bb", "offline"))
    assert state.answers_for("bb")


@pytest.mark.parametrize("boot_id", ["aa", "bb"], ids=["late will of an earlier connection", "of an earlier run"])
async def test_a_message_that_overwrites_the_state_is_overwritten_at_once_and_then_seldom(
    boot_id: str,
    state: DaemonState,
    sent: list[DaemonSnapshot],
    restored: list[None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    skip = skipping(monkeypatch)
    for number in range(10):
        state.receive(incoming(boot_id, "offline"))
        assert len(sent) == len(restored) == min(number + 1, 2)
    await skip(RESTORE_S)
    assert len(sent) == len(restored) == 3
    assert reason_code(state) is ReasonCode.MEASURING


async def test_the_conflict_is_over_when_the_others_are_offline_or_silent(
    state: DaemonState, sent: list[DaemonSnapshot], restored: list[None], monkeypatch: pytest.MonkeyPatch
) -> None:
    skip = skipping(monkeypatch)
    for boot_id in ("bb", "cc"):
        state.receive(incoming(boot_id))
    state.receive(incoming("bb", "offline"))
    assert "boot id cc)" in state.snapshot.reason.text
    await skip(SILENT_S - 1.0)
    state.receive(incoming("cc"))
    await skip(SILENT_S - 1.0)
    assert sent[-1].reason.code is ReasonCode.NAME_CONFLICT
    before = len(sent)
    await skip(1.0)
    assert sent[before:] == [state.snapshot]
    assert (reason_code(state), len(restored)) == (ReasonCode.MEASURING, len(sent))


@pytest.mark.parametrize(
    "payload",
    [b"", b"{}", b"[]", b"7", b"\xff", b'{"daemon_boot_id": "b"}', b"[" * 100_000, b'{"state": "online"}']
    + [
        json.dumps({"daemon_boot_id": boot_id, "state": "online", "t_ns": "1"}).encode()
        for boot_id in (7, None, "", "x" * 65, "a\nb", ["b"], {"b": 1})
    ],
)
async def test_malformed_states_are_overwritten(state: DaemonState, sent: list[DaemonSnapshot], payload: bytes) -> None:
    state.receive(Incoming("resonator/hand/state/daemon", payload, False, None, None))
    assert (reason_code(state), sent) == (ReasonCode.MEASURING, [state.snapshot])
