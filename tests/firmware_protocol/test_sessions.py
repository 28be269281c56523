"""Host and board sessions facing each other, and each against what the other must not send."""

import re
from pathlib import Path

import pytest

import firmware_protocol.host
from firmware_protocol.device import MAX_TONES_PER_PART, DeviceSession, DeviceState
from firmware_protocol.host import Described, Frame, FramePart, HostSession, HostState, Pong, Rebooted, Started
from firmware_protocol.layouts import SINGLE_TONE_STRUCT, TONE_STRUCT, MessageType, SingleToneRecord
from firmware_protocol.messages import (
    BoardLog,
    BoardStatus,
    Configuration,
    CounterKind,
    Description,
    Identity,
    Refusal,
    RefusalCode,
    encode_message,
)
from firmware_protocol.packets import MAX_PAYLOAD_BYTES, ForeignVersion, Packet, PacketDecoder, encode_packet

PAGE = Path(firmware_protocol.host.__file__).with_name("PROTOCOL.md").read_text()
IDENTITY = Identity("test plate", "0042", "1.0", 0)
DESCRIPTION = Description(CounterKind.SINGLE_TONE, 4, 1, 10**12, 10**5, 10**8, "quartz16")
RECORD = SingleToneRecord(1, 2, 3, 10, 5, 6, 7, 8, 9, 0)


def new_device(boot_id: int = 0x1234) -> DeviceSession:
    return DeviceSession(IDENTITY, DESCRIPTION, boot_id)


def exchange(host: HostSession, device: DeviceSession) -> list[object]:
    """Carry bytes both ways until nobody has anything to say."""
    events: list[object] = []
    while request := host.data_to_send():
        events += host.receive(device.receive(request, board_ticks=500))
    return events


def running() -> tuple[HostSession, DeviceSession]:
    host, device = HostSession(), new_device()
    exchange(host, device)
    host.configure(Configuration(10**6))
    exchange(host, device)
    return host, device


def test_handshake_reaches_frames() -> None:
    host, device = HostSession(), new_device()
    assert exchange(host, device) == [Described(IDENTITY, DESCRIPTION, 0x1234)]
    assert host.state is HostState.DESCRIBED
    host.configure(Configuration(10**6))
    assert exchange(host, device) == [Started(Configuration(10**6))]
    assert (host.state, device.state) == (HostState.RUNNING, DeviceState.RUNNING)
    raw = device.frame(0, 123, SINGLE_TONE_STRUCT.pack(*RECORD) * 4)
    assert len(raw) == 204
    assert host.receive(raw) == [Frame(0, 123, 204, (RECORD,) * 4)]


def test_record_layout_is_the_one_of_the_page() -> None:
    section = PAGE.split("## 4.")[1].split("## 5.")[0]
    rows = re.findall(r"^\| (\d+) \| (\d+) \| (\w+) \|", section, re.MULTILINE)
    offset = 0
    for (at, size, name), field in zip(rows, SingleToneRecord._fields, strict=True):
        assert (int(at), name) == (offset, field)
        offset += int(size)
    assert offset == SINGLE_TONE_STRUCT.size == 44


def test_message_numbers_are_those_of_the_page() -> None:
    rows = re.findall(r"^\| 0x([0-9A-F]{2}) \| (\w+) \| (host|board) \|", PAGE, re.MULTILINE)
    assert {name: int(code, 16) for code, name, _ in rows} == {member.name: member.value for member in MessageType}
    assert all((int(code, 16) >= 0x80) == (sender == "board") for code, _, sender in rows)


def test_channelised_frame_travels_in_parts_of_at_most_9_kb() -> None:
    host, device = running()
    records = [TONE_STRUCT.pack(channel, tone, 0, 128, 0) for channel in range(4) for tone in range(3072)]
    channels = [b"".join(records[channel * 3072 : (channel + 1) * 3072]) for channel in range(4)]
    parts = device.frame_parts(5, 99, channels)
    assert max(map(len, parts)) <= 9000
    events = [event for raw in parts for event in host.receive(raw)]
    assert all(isinstance(event, FramePart) and event.sequence == 5 for event in events)
    found = [event for event in events if isinstance(event, FramePart)]
    assert [event.block.part for event in found] == list(range(len(parts)))
    assert {event.block.parts for event in found} == {len(parts)}
    for channel in range(4):
        mine = [event for event in found if event.block.channel == channel]
        assert b"".join(event.tones for event in mine) == channels[channel]
        assert sum(event.block.tones for event in mine) == 3072
    assert MAX_TONES_PER_PART == 744
    assert MAX_PAYLOAD_BYTES - (8 + 12 * 744) < 12


def test_lost_answers_are_asked_for_again_without_a_second_run() -> None:
    host, device = HostSession(), new_device()
    device.receive(host.data_to_send(), 0)  # the answer is lost
    assert host.data_to_send() == b""
    host.ask_again()
    exchange(host, device)
    host.configure(Configuration(10**6))
    events = host.receive(device.receive(host.data_to_send(), 0))
    device.receive(host.data_to_send(), 0)  # STARTED is lost
    assert events == []
    assert host.state is HostState.STARTING
    host.receive(device.frame(0, 1, SINGLE_TONE_STRUCT.pack(*RECORD) * 4))
    assert host.messages.stale == 1
    host.ask_again()
    assert exchange(host, device) == [Started(Configuration(10**6))]
    assert device.started == 1


def test_duplicated_answers_change_nothing() -> None:
    host, device = HostSession(), new_device()
    answer = device.receive(host.data_to_send(), 0)
    host.receive(answer)
    host.receive(answer)
    assert host.state is HostState.DESCRIBING
    assert host.messages.stale == 1


def test_ping_carries_ticks_also_during_the_handshake() -> None:
    host, device = HostSession(), new_device()
    host.ping(b"12345678")
    assert exchange(host, device)[0] == Pong(b"12345678", 500)
    assert host.state is HostState.DESCRIBED


def test_reboot_is_seen_and_the_handshake_begins_again() -> None:
    host, old = running()
    reborn = new_device(boot_id=0x9999)
    events = host.receive(reborn.status(BoardStatus(0), 1))
    assert events == [Rebooted(0x9999), BoardStatus(0)]
    assert exchange(host, reborn) == [Described(IDENTITY, DESCRIPTION, 0x9999)]
    assert old.state is DeviceState.RUNNING


def test_frames_before_the_start_are_stale() -> None:
    host, device = HostSession(), new_device()
    assert host.receive(device.frame(0, 1, SINGLE_TONE_STRUCT.pack(*RECORD) * 4)) == []
    assert host.messages.stale == 1


def test_other_major_version_is_an_event() -> None:
    assert HostSession().receive(encode_packet(0x81, 1, b"?", boot_id=1, major=2)) == [ForeignVersion(2)]


@pytest.mark.parametrize("gate_ticks", [0, 99_999, 100_000_001])
def test_board_refuses_a_gate_out_of_range(gate_ticks: int) -> None:
    host, device = HostSession(), new_device()
    exchange(host, device)
    host.configure(Configuration(gate_ticks))
    text = f"gate_ticks must be 100000 to 100000000, got {gate_ticks}"
    assert exchange(host, device) == [Refusal(RefusalCode.OUT_OF_RANGE, text)]
    assert host.state is HostState.REFUSED


def refusal_code(device: DeviceSession, message_type: int, payload: bytes = b"") -> int:
    (packet,) = PacketDecoder(from_board=True).feed(device.receive(encode_packet(message_type, 3, payload), 0))
    assert isinstance(packet, Packet)
    assert (packet.type, packet.sequence) == (MessageType.REFUSED, 3)
    return packet.payload[2]  # the first field's value


def test_board_refuses_by_code() -> None:
    assert refusal_code(new_device(), MessageType.START) == RefusalCode.NOT_IN_THIS_STATE
    assert refusal_code(new_device(), 0x44) == RefusalCode.UNKNOWN_MESSAGE
    assert refusal_code(new_device(), MessageType.CONFIGURE, b"\x01") == RefusalCode.MALFORMED


def test_stop_and_configure_end_a_run() -> None:
    host, device = running()
    host.stop()
    exchange(host, device)
    assert device.state is DeviceState.CONFIGURED
    _, device = running()
    device.receive(encode_packet(MessageType.CONFIGURE, 9, encode_message(Configuration(2 * 10**6))), 0)
    assert device.state is DeviceState.CONFIGURED
    assert device.configuration == Configuration(2 * 10**6)
    _, device = running()
    device.receive(encode_packet(MessageType.STOP, 1), 0)
    device.receive(encode_packet(MessageType.START, 2), 0)
    assert device.started == 2


def test_board_ignores_its_own_echo() -> None:
    device = new_device()
    assert device.receive(device.log(BoardLog(20, "hello"), 1), 2) == b""


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


def test_configure_needs_a_described_board() -> None:
    with pytest.raises(ValueError, match="needs a described board, the session is identifying"):
        HostSession().configure(Configuration(1))
