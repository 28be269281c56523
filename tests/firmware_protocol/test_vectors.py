"""The vectors that every implementation of the wire must pass, passed by the Python one."""

import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from vector_files import VECTORS, board_of, cases, check_sent, expected_events, named

import firmware_protocol.packets as packets_module
from firmware_protocol import messages
from firmware_protocol.device import DeviceSession
from firmware_protocol.output_queue import Outgoing, OutputQueue
from firmware_protocol.packets import PacketDecoder

MESSAGES = {
    "CONFIGURE": messages.Configuration, "IDENTITY": messages.Identity, "STATUS": messages.BoardStatus,
    "LOG": messages.BoardLog, "REFUSED": messages.Refusal
}  # fmt: skip


def test_files_are_what_the_script_makes(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "firmware_protocol.vectors.make", tmp_path], check=True)
    made = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert made == {path.name: path.read_text() for path in VECTORS.glob("*.json")}


@pytest.mark.parametrize("case", cases("checks"))
def test_checks(case: dict[str, Any]) -> None:
    data = bytes.fromhex(case["bytes"])
    value = packets_module.crc_hqx(data, 0xFFFF) if case["check"] == "header_check" else packets_module.crc32(data)
    assert value == case["value"]


@pytest.mark.parametrize("piece_bytes", [1, 3, 10_000])
@pytest.mark.parametrize("case", cases("streams"), ids=named)
def test_streams(case: dict[str, Any], piece_bytes: int) -> None:
    decoder = PacketDecoder(from_board=case["from_board"], max_packet_bytes=case["max_packet_bytes"])
    stream = bytes.fromhex(case["stream"])
    found = []
    for start in range(0, len(stream), piece_bytes):
        found += decoder.feed(stream[start : start + piece_bytes])
    assert found == expected_events(case)
    assert asdict(decoder.counts) | {"waiting": decoder.waiting_bytes} == case["counts"]


@pytest.mark.parametrize("case", cases("messages"), ids=named)
def test_messages(case: dict[str, Any]) -> None:
    kind, payload = MESSAGES[case["message"]], bytes.fromhex(case["payload"])
    if "malformed" in case:
        with pytest.raises(messages.MalformedMessageError):
            messages.decode_message(kind, payload)
        return
    message = kind(**case["fields"])
    assert messages.decode_message(kind, payload) == message
    assert (messages.encode_message(message) == payload) == case["canonical"]


@pytest.mark.parametrize("case", cases("board_sessions"), ids=named)
def test_board_sessions(case: dict[str, Any]) -> None:
    session = DeviceSession(*board_of(case))
    queue = OutputQueue(session, case["board"]["description"]["queue_bytes"])
    runs, sequence, begun = 0, 0, False
    for step in case["steps"]:
        ticks = step.get("ticks", 0)
        match step["do"]:
            case "receive":
                answers = session.receive(bytes.fromhex(step["bytes"]), ticks)
                if session.started != runs:
                    runs, sequence = session.started, 0
                    queue.begin_run()
                queue.put(Outgoing(answers))
            case "frame":
                queue.put(Outgoing(session.frame(sequence, ticks, bytes.fromhex(step["records"])), sequence))
                sequence += 1
            case "skip":
                sequence += 1
            case "begin":
                queue.begin()
            case "fault":
                queue.set_fault(step["text"], ticks)
            case "connect":
                assert queue.host_connects(ticks) is step["served"]
            case "disconnect":
                queue.connection_ended(frames_cut=begun)
        if step.get("takes") == 0:
            continue
        sent = b"".join(outgoing.data for outgoing in iter(lambda: queue.take(ticks), None))  # noqa: B023 - read here
        begun = "takes" in step
        check_sent(step, sent[: step.get("takes")])
        assert session.state.value == step["state"], step
