import json
import struct

import pytest

from resonator_daemon.base.host.load import LoadSample
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.session import link_events as wire
from resonator_daemon.board.session.clock import HostTime

NOW = HostTime(5, 7, 3)


def raw(kind: int, body: object) -> bytes:
    return struct.pack("<Bq", kind, 3) + (body if isinstance(body, bytes) else json.dumps(body).encode())


@pytest.mark.parametrize(
    "data",
    [
        raw(0, ["doubtful", "a state that no link has"]), raw(0, ["lost", "\ud800"]),
        raw(7, [["unplugged", "\ud800"]]), raw(7, [[["unplugged"], "gone"]]), raw(7, [["unplugged", 1]]),
        raw(7, ["half of \udc00 a pair"]), raw(8, [["\ud800"], True]), raw(13, ["\ud800", "{}"]),
        raw(13, ["key", "\ud800"]), raw(10, [-1, 5]), raw(10, [5, -1]), raw(10, [1, 2**63]),
        raw(11, {"state": ["doubtful", "", 0, []]}), raw(11, b"[" * 100_000), raw(7, b"[" * 100_000), raw(0, b"{"),
        raw(0, ["a"]), raw(7, [1]), raw(255, b""), b"", bytes(8)
    ],
)  # fmt: skip
def test_what_no_daemon_wrote_is_damage(data: bytes) -> None:
    with pytest.raises((ValueError, RecursionError)) as caught:
        wire.decode(data, 5, 12)
    assert len(str(caught.value)) < 200
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "event",
    [
        wire.StateAnnounced(NOW, Condition.LOST, Reason(ReasonCode.UNPLUGGED, "/dev/tty\udcff is gone")),
        wire.Lost(NOW, Reason(ReasonCode.UNPLUGGED, "/dev/tty\udcff is gone")),
        wire.Refused(
            NOW, (Reason(ReasonCode.WRONG_PLATE, "a"), Reason(ReasonCode.WRONG_GATE, "/dev/tty\udcff")), False
        ),
        wire.ControlRequested(NOW, "\udcff", "{}"),
        wire.Skipped(NOW, 0, 2**63 - 1),
    ],
)
def test_a_path_that_is_no_text_is_written_as_one_that_is(
    event: wire.StateAnnounced | wire.Lost | wire.Refused | wire.ControlRequested | wire.Skipped,
) -> None:
    again = wire.decode(wire.encode(event), 5, 12)
    assert repr(again) == repr(event).replace("\\udcff", "?")


@pytest.mark.parametrize("reason", ["gone", ["a code of a later version", "gone"]])
def test_a_reason_without_a_code_that_is_known_is_unspecified(reason: object) -> None:
    unspecified = Reason(ReasonCode.UNSPECIFIED, "gone")
    assert wire.decode(raw(7, [reason]), 5, 12) == wire.Lost(NOW, unspecified)
    assert wire.decode(raw(8, [[reason], True]), 5, 12) == wire.Refused(NOW, (unspecified,), other_protocol=True)


@pytest.mark.parametrize(("load", "body"), [(LoadSample(85, 100), b"\1\x55\x64"), (LoadSample(), b"\1")])
def test_the_load_of_the_host_is_recorded_if_it_is_not_zero(load: LoadSample, body: bytes) -> None:
    event = wire.TimersRun(NOW, True, load)
    assert wire.encode(event) == raw(3, body)
    assert wire.decode(raw(3, body), 5, 12) == event
