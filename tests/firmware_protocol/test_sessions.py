"""Host and board sessions facing each other, and each against what the other must not send."""

from dataclasses import replace

import pytest
from protocol_sessions import BOOT, DESCRIPTION, GATE, IDENTITY, RECORD, RECORDS, exchange, new_device, running

from firmware_protocol.device import DeviceSession
from firmware_protocol.host import Frame, FramePart, HostSession, Located, Started
from firmware_protocol.layouts import Block, MessageType
from firmware_protocol.messages import Refusal, RefusalCode
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
    assert (host.messages.stale, host.messages.frames_outside_run) == (1, 1)
    host.ask_again()
    assert exchange(host, device) == [Started(GATE)]
    assert device.started == 1


def test_a_request_of_another_version_is_no_event_of_a_board() -> None:
    assert HostSession().receive(encode_packet(0x01, 1, b"?", major=2)) == []


def test_board_without_a_light_cannot_be_located() -> None:
    host, dark = HostSession(), DeviceSession(IDENTITY, replace(DESCRIPTION, capabilities=0), BOOT)
    exchange(host, dark)
    host.locate()
    assert exchange(host, dark) == [Located(Refusal(RefusalCode.UNKNOWN_MESSAGE, "unknown message 0x07"))]
    assert host.state is HostState.DESCRIBED
    host.stop()
    assert host.receive(encode_packet(MessageType.LOCATED, host.number, boot_id=BOOT)) == []


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


@pytest.mark.parametrize(
    ("kind", "payload", "code"),
    [
        (MessageType.FRAME, bytes(175), "frame_length"),
        (MessageType.FRAME_PART, bytes(7), "frame_part"),
        (MessageType.FRAME_PART, bytes((4, 0, 0, 0, 0, 0, 0, 1)), "frame_part"),
        (MessageType.FRAME_PART, bytes((0, 0, 0, 0, 1, 0, 0, 1)), "frame_part"),
        (MessageType.FRAME_PART, bytes((0, 0, 0, 0, 0, 0, 2, 2)), "frame_part"),
        (MessageType.LOG, b"\x01", "message_fields"),
        (0xC0, b"", None),
        (MessageType.FRAME_PART, bytes((0, 9, 0, 0, 0, 0, 0, 1)), None),
    ],
)
def test_what_a_host_cannot_read_is_counted_by_its_reason(kind: int, payload: bytes, code: str | None) -> None:
    host, _ = running()
    assert host.receive(encode_packet(kind, 0, payload, boot_id=BOOT)) == []
    assert (host.messages.malformed, host.messages.unknown) == (code is not None, code is None)
    assert [refusal.code for refusal in host.refusals] == [code] * (code is not None)


def test_reasons_beyond_sixteen_share_a_text() -> None:
    host, _ = running()
    for size in (*range(18), 3, 3):
        host.receive(encode_packet(MessageType.FRAME, 0, bytes(size), boot_id=BOOT))
    assert list(host.refusals.values()) == [1, 1, 1, 3, *[1] * 12, 2]
    assert host.most_refused == list(host.refusals)[3]


def test_frames_arrive_as_they_were_sent() -> None:
    host, device = running()
    assert host.configuration == GATE
    (frame,) = host.receive(device.frame(7, 9, RECORDS))
    assert frame == Frame(7, 9, 204, RECORDS)
    assert frame.records == (RECORD,) * 4
    channels = [bytes([channel]) * (12 * 745) for channel in range(4)]
    expected = [
        FramePart(8, 10, 36 + 12 * tones, Block(channel, 0, first, tones, 2 * channel + half, 8), tones * data[:12])
        for channel, data in enumerate(channels)
        for half, (first, tones) in enumerate(((0, 373), (373, 372)))
    ]
    assert host.receive(device.frame_parts(8, 10, channels)) == expected
