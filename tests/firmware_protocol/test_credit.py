"""A host never sends more than the board has room for, and no lost answer stops it for ever."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from protocol_sessions import BOOT, GATE, IDENTITY, exchange, new_device, packets_in, running

from firmware_protocol.host import HostSession, Pong, Requests
from firmware_protocol.layouts import MessageType
from firmware_protocol.packets import encode_packet
from firmware_protocol.states import HostState

PING = bytes(8)


def types(data: bytes) -> list[int]:
    return [packet.type for packet in packets_in(data)]


def test_requests_wait_in_order_until_there_is_room() -> None:
    host, device = running()
    host.ping(PING)
    ping = host.data_to_send()
    host.locate()  # fits beside the ping
    host.stop()
    assert types(host.data_to_send()) == [MessageType.LOCATE]
    assert not host.ping(PING)
    host.receive(device.receive(ping, 0))
    assert types(host.data_to_send()) == [MessageType.STOP]


def test_an_answer_gives_back_what_was_asked_before_it() -> None:
    host, device = running(replace(IDENTITY, credit_bytes=110))
    assert [host.ping(bytes([n] * 8)) for n in range(4)] == [True, True, True, False]
    pings = host.data_to_send()
    answers = [device.receive(pings[at : at + 36], 0) for at in (0, 36, 72)]
    host.receive(answers[1])  # the first is lost
    assert [host.ping(PING), host.ping(PING), host.ping(PING)] == [True, True, False]


def test_a_lost_answer_is_overdue_and_gives_its_room_back() -> None:
    host, device = running()
    assert not host.awaits_answer
    host.ping(PING)
    device.receive(host.data_to_send(), 0)  # the answer is lost
    assert host.awaits_answer
    assert not host.ping(PING)
    host.ask_again()
    assert host.data_to_send() == b""  # a ping is not repeated: its time has passed
    assert host.ping(PING)
    assert exchange(host, device) == [Pong(PING, 500)]
    assert not host.awaits_answer


def test_a_repeated_request_goes_before_those_that_wait() -> None:
    host, device = HostSession(), new_device()
    exchange(host, device)
    host.ping(PING)
    host.data_to_send()
    host.configure(GATE)  # 36 + 33 bytes are too many
    assert host.data_to_send() == b""
    host.locate()
    host.ask_again()
    assert types(host.data_to_send()) == [MessageType.CONFIGURE, MessageType.LOCATE]


def test_a_malformed_answer_is_still_awaited() -> None:
    host = HostSession()
    first = host.data_to_send()
    host.receive(encode_packet(MessageType.IDENTITY, 1, b"\x01", boot_id=BOOT))
    assert (host.messages.malformed, host.awaits_answer) == (1, True)
    host.ask_again()
    assert host.data_to_send() == first


def test_a_host_that_stops_withdraws_what_still_waits() -> None:
    host, device = HostSession(), new_device()
    exchange(host, device)
    host.ping(PING)
    ping = host.data_to_send()
    host.configure(GATE)
    host.stop()
    host.receive(device.receive(ping, 0))
    assert types(host.data_to_send()) == [MessageType.STOP]
    assert host.state is HostState.DESCRIBED


def test_another_boot_forgets_requests_and_credit() -> None:
    host, _ = running(replace(IDENTITY, credit_bytes=1000))
    host.locate()
    host.stop()
    host.receive(encode_packet(MessageType.LOG, 0, bytes((1, 1, 20, 2, 0)), boot_id=BOOT + 1))
    assert types(host.data_to_send()) == [MessageType.IDENTIFY]
    assert [host.ping(PING), host.ping(PING)] == [True, False]


def test_numbers_wrap() -> None:
    requests = Requests()
    requests.number = 0xFFFFFFFE
    assert [requests.send(MessageType.PING).number for _ in range(3)] == [0xFFFFFFFF, 0, 1]


@pytest.mark.parametrize("credit_bytes", [64, 100, 256])
@given(acts=st.lists(st.sampled_from(["ping", "locate", "stop", "lose", "answer", "again"]), max_size=60))
def test_outstanding_bytes_never_exceed_the_credit(credit_bytes: int, acts: list[str]) -> None:
    host, device = running(replace(IDENTITY, credit_bytes=credit_bytes))
    on_the_way: list[int] = []  # sizes of requests that the board has not answered
    line = b""
    for act in acts:
        if act == "ping":
            host.ping(PING)
        elif act == "locate":
            host.locate()
        elif act == "stop":
            host.stop()
        elif act == "again":
            on_the_way.clear()
            host.ask_again()
        sent = host.data_to_send()
        on_the_way += [packet.size_bytes for packet in packets_in(sent)]
        assert sum(on_the_way) <= credit_bytes
        line += sent
        if act in ("lose", "answer"):
            answers = device.receive(line, 0)
            line = b""
            if act == "answer" and answers:
                on_the_way.clear()
                host.receive(answers)
                sent = host.data_to_send()
                on_the_way += [len(sent)] if sent else []
                line += sent
    assert len(host.requests._waiting) <= 4
