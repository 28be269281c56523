"""State of the daemon: connections to the broker, and conflicts with daemons of the same name."""

import json

import pytest
from observer import skipping

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.daemon_state import SILENT_S, DaemonSnapshot, DaemonState
from resonator_daemon.mqtt.payloads import Condition

MEASURING = Reason(ReasonCode.MEASURING, "measuring")


def incoming(boot_id: str, state: str, at: str = "1", *, retained: bool = False, connected: object = None) -> Incoming:
    content = {"daemon_boot_id": boot_id, "state": state, "t_ns": at, "connected_t_ns": connected}
    return Incoming("resonator/hand/state/daemon", json.dumps(content).encode(), retained, None, None)


@pytest.fixture
def sent() -> list[DaemonSnapshot]:
    return []


@pytest.fixture
def restored() -> list[None]:
    """One element for each restoration of overwritten topics."""
    return []


@pytest.fixture
async def state(sent: list[DaemonSnapshot], restored: list[None]) -> DaemonState:
    state = DaemonState("aa", sent.append, lambda: restored.append(None))
    state.become(Condition.ONLINE, MEASURING, 5)
    state.connected(1)
    sent.clear()
    return state


def run_daemons(state: DaemonState, *boot_ids: str) -> None:
    """Receive two messages of each running daemon."""
    for at in ("1", "2"):
        for boot_id in boot_ids:
            state.receive(incoming(boot_id, "online", at))


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
    state.announce()
    state.end()
    state.announce()
    assert sent == [again, again]


async def test_one_message_is_no_evidence_of_another_daemon(state: DaemonState) -> None:
    for condition, at in (("online", "1"), ("online", "1"), ("offline", "2"), ("online", "3")):
        state.receive(incoming("bb", condition, at))
    state.receive(incoming("bb", "online", "4", retained=True))
    assert reason_code(state) is ReasonCode.MEASURING
    assert state.answers_for("bb")
    run_daemons(state, "bb")
    assert reason_code(state) is ReasonCode.NAME_CONFLICT
    state.connected(2)
    assert reason_code(state) is ReasonCode.MEASURING


async def test_thousands_of_forged_boot_ids_are_not_listed_and_do_not_hide_a_daemon(
    state: DaemonState, sent: list[DaemonSnapshot]
) -> None:
    for number in range(3000):
        state.receive(incoming(f"b{number}", "online"))
    run_daemons(state, "cc")
    assert "boot id cc)" in state.snapshot.reason.text
    for number in range(3000):
        run_daemons(state, f"b{number}")
    assert len(state.snapshot.reason.text) < 400
    assert len(sent) == 1


async def test_of_two_daemons_one_answers_for_a_run(state: DaemonState) -> None:
    connected_ns = state.snapshot.connected_utc_ns or 0
    run_daemons(state, "bb")
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


async def test_the_conflict_is_over_when_the_others_are_offline(
    state: DaemonState, sent: list[DaemonSnapshot], restored: list[None]
) -> None:
    run_daemons(state, "bb", "cc")
    state.receive(incoming("bb", "offline"))
    assert "boot id cc)" in state.snapshot.reason.text
    for _ in range(10):  # frequent changes are announced with the next restoration
        state.receive(incoming("cc", "offline"))
        assert reason_code(state) is ReasonCode.MEASURING
        run_daemons(state, "cc")
    assert (len(sent), len(restored)) == (1, 1)


async def test_the_conflict_is_over_when_the_other_is_silent(
    state: DaemonState, sent: list[DaemonSnapshot], restored: list[None], monkeypatch: pytest.MonkeyPatch
) -> None:
    skip = skipping(monkeypatch)
    run_daemons(state, "bb")
    await skip(SILENT_S - 1.0)
    state.receive(incoming("bb", "online", "3"))
    await skip(SILENT_S - 1.0)
    assert [snapshot.reason.code for snapshot in sent] == [ReasonCode.NAME_CONFLICT]
    await skip(1.0)
    assert sent[1:] == [state.snapshot]
    state.receive(incoming("bb", "online", "4"))
    await skip(SILENT_S)
    state.receive(incoming("bb", "online", "5"))
    assert (reason_code(state), len(sent), len(restored)) == (ReasonCode.MEASURING, 2, 1)


@pytest.mark.parametrize(
    "payload",
    [b"", b"{}", b"[]", b"7", b"\xff", b'{"daemon_boot_id": "b"}', b"[" * 100_000, b'{"state": "online"}']
    + [
        json.dumps({"daemon_boot_id": boot_id, "state": "online", "t_ns": at}).encode()
        for boot_id, at in (*((b, "1") for b in (7, None, "", "x" * 65, "a\nb", ["b"], {"b": 1})), ("b", 1), ("b", "x"))
    ],
)
async def test_malformed_messages_are_ignored(state: DaemonState, sent: list[DaemonSnapshot], payload: bytes) -> None:
    for digit in (b"1", b"2"):
        message = payload.replace(b"1", digit)
        state.receive(Incoming("resonator/hand/state/daemon", message, False, None, None))
    assert (reason_code(state), sent) == (ReasonCode.MEASURING, [])
