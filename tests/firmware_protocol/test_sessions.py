"""Host and board sessions facing each other, and each against what the other must not send."""

from dataclasses import replace

import pytest
from protocol_sessions import BOOT, DESCRIPTION, GATE, IDENTITY, RECORDS, exchange, new_device, running

from firmware_protocol.device import DeviceSession
from firmware_protocol.host import HostSession, Located, Started
from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import Configuration, Refusal, RefusalCode
from firmware_protocol.packets import encode_packet
from firmware_protocol.states import HostState


def test_lost_answers_are_asked_for_again_without_a_second_run() -> None:
    host, device = HostSession(), new_device()
    device.receive(host.data_to_send(), 0)  # the answer is lost
    assert host.data_to_send() == b""
    host.ask_again()
    exchange(host, device)
    host.configure(GATE)
    events = host.receive(device.receive(host.data_to_send(), 0))
    device.receive(host.data_to_send(), 0)  # STARTED is lost
    assert events == []
    assert host.state is HostState.STARTING
    host.receive(device.frame(0, 1, RECORDS))
    assert host.messages.stale == 1
    host.ask_again()
    assert exchange(host, device) == [Started(GATE)]
    assert device.started == 1


def test_a_request_of_another_version_is_no_event_of_a_board() -> None:
    assert HostSession().receive(encode_packet(0x01, 1, b"?", major=2)) == []


@pytest.mark.parametrize("gate_ticks", [0, 99_999, 100_000, 100_050, 100_000_000, 100_000_001])
def test_board_takes_the_gates_within_its_limits_alone(gate_ticks: int) -> None:
    host, device = HostSession(), new_device()
    exchange(host, device)
    host.configure(Configuration(gate_ticks))
    (answer,) = exchange(host, device)
    if gate_ticks in (100_000, 100_000_000):
        assert answer == Started(Configuration(gate_ticks))
    else:
        assert isinstance(answer, Refusal)
        assert (answer.code, host.state) == (RefusalCode.OUT_OF_RANGE, HostState.REFUSED)


def test_board_without_a_light_cannot_be_located() -> None:
    host, dark = HostSession(), DeviceSession(IDENTITY, replace(DESCRIPTION, capabilities=0), BOOT)
    exchange(host, dark)
    host.locate()
    assert exchange(host, dark) == [Located(Refusal(RefusalCode.UNKNOWN_MESSAGE, "unknown message 0x07"))]
    assert host.state is HostState.DESCRIBED


def test_resumed_board_begins_a_run_only_if_it_had_stopped() -> None:
    host, device = running()
    host.resume()
    assert exchange(host, device) == [Started(GATE)]
    assert device.started == 1
    device.receive(encode_packet(MessageType.STOP, 1), 0)  # as another host would
    host.resume()
    assert exchange(host, device) == [Started(GATE)]
    assert device.started == 2
    device.begin()
    host.resume()
    (refused,) = exchange(host, device)
    assert isinstance(refused, Refusal)
    assert host.state is HostState.REFUSED


def test_malformed_and_unknown_messages_are_counted() -> None:
    host, _ = running()
    host.receive(encode_packet(MessageType.FRAME, 0, bytes(175), boot_id=0x1234))
    host.receive(encode_packet(MessageType.FRAME_PART, 0, bytes(7), boot_id=0x1234))
    host.receive(encode_packet(MessageType.FRAME_PART, 0, bytes((4, 0, 0, 0, 0, 0, 0, 1)), boot_id=0x1234))
    host.receive(encode_packet(MessageType.FRAME_PART, 0, bytes((0, 0, 0, 0, 1, 0, 0, 1)), boot_id=0x1234))
    host.receive(encode_packet(MessageType.FRAME_PART, 0, bytes((0, 0, 0, 0, 0, 0, 2, 2)), boot_id=0x1234))
    host.receive(encode_packet(MessageType.FRAME_PART, 0, bytes(8), boot_id=0x1234))
    host.receive(encode_packet(MessageType.LOG, 0, b"\x01", boot_id=0x1234))
    assert host.messages.malformed == 7
    host.receive(encode_packet(0xC0, 0, boot_id=0x1234))
    host.receive(encode_packet(MessageType.FRAME_PART, 0, bytes((0, 9, 0, 0, 0, 0, 0, 1)), boot_id=0x1234))
    assert host.messages.unknown == 2
