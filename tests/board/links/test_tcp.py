"""Connecting over TCP on the loopback: bytes both ways, peers that misbehave, nobody there, names no host can have."""

import contextlib
import ctypes
import socket
import struct
from collections.abc import Iterator
from types import SimpleNamespace
from typing import NamedTuple

import pytest

from resonator_daemon.board.links.carriers import tcp as tcp_link
from resonator_daemon.board.links.carriers.tcp import TcpTarget, open_tcp
from resonator_daemon.board.links.link import FileDescriptorLink, LinkLostError, LinkUnavailableError

AMPLE_S = 30.0
SO_ATTACH_FILTER = 26


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(AMPLE_S)
        yield listener


class Connected(NamedTuple):
    link: FileDescriptorLink
    board: socket.socket


@pytest.fixture
def connected(listener: socket.socket) -> Iterator[Connected]:
    """A link and the board's end of its connection."""
    link = open_tcp(target(listener))
    board, _ = listener.accept()
    with board:
        board.settimeout(AMPLE_S)
        yield Connected(link, board)
    link.close()


def target(listener: socket.socket) -> TcpTarget:
    return TcpTarget("127.0.0.1", listener.getsockname()[1])


def cut_off(board: socket.socket) -> None:
    """Let nothing through to this end: no end of stream, no reset, no acknowledgement, as when a cable is cut."""
    drop_all = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))
    board.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, struct.pack("HxxxxxxP", 1, ctypes.addressof(drop_all)))


def test_a_board_that_vanished_is_noticed_by_what_it_does_not_acknowledge(listener: socket.socket) -> None:
    link = open_tcp(target(listener), unacknowledged_ms=300)
    board, _ = listener.accept()
    with board:
        cut_off(board)
        link.write(b"who are you?")
        with pytest.raises(LinkLostError, match="Connection timed out"):
            link.read(AMPLE_S)
    link.close()


def test_a_board_that_vanished_without_a_word_is_noticed(connected: Connected) -> None:
    cut_off(connected.board)
    with pytest.raises(LinkLostError, match="Connection timed out"):
        connected.link.read(AMPLE_S)


def test_a_board_that_serves_another_program_is_not_unplugged(connected: Connected) -> None:
    connected.board.close()
    for _ in range(2):
        with pytest.raises(LinkLostError) as caught:
            connected.link.read(AMPLE_S)
        assert caught.value.reason.code == "port_in_use"


def test_a_host_that_does_not_answer_is_given_up() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as busy:
        where = target(busy)
        with contextlib.ExitStack() as waiting:
            for _ in range(2):  # its queue is full: the next attempt gets no answer at all
                client = waiting.enter_context(socket.socket())
                client.setblocking(False)
                client.connect_ex(("127.0.0.1", where.port))
            with pytest.raises(LinkUnavailableError) as caught:
                open_tcp(where, timeout_s=0.05)
            assert caught.value.reason.code == "host_unreachable"


def test_all_addresses_and_the_name_share_one_time(monkeypatch: pytest.MonkeyPatch) -> None:
    instants = iter((0.0, 1.0, 2.5))  # the name took a second, the first address one and a half
    given = []

    def connect(_family: int, _address: object, timeout_s: float, _unacknowledged_ms: int) -> socket.socket:
        given.append(timeout_s)
        raise TimeoutError("timed out")

    monkeypatch.setattr(tcp_link, "time", SimpleNamespace(monotonic=lambda: next(instants)))
    monkeypatch.setattr(
        tcp_link, "resolve_host", lambda _host, _port, _timeout_s: [(socket.AF_INET, ("192.0.2.1", 5000))] * 2
    )
    monkeypatch.setattr(tcp_link, "connect", connect)
    with pytest.raises(LinkUnavailableError, match=r"192\.0\.2\.1: no answer in time; 192"):
        open_tcp(TcpTarget("board.local", 5000))
    assert given == [2.0, 0.5]


def test_the_next_address_of_a_host_is_tried(listener: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    port = target(listener).port
    addresses = [(socket.AF_INET, ("127.0.0.2", 1)), (socket.AF_INET, ("127.0.0.1", port))]
    monkeypatch.setattr(tcp_link, "resolve_host", lambda _host, _port, _timeout_s: addresses)
    open_tcp(TcpTarget("board.local", port)).close()
    monkeypatch.setattr(tcp_link, "resolve_host", lambda _host, _port, _timeout_s: addresses[:1] * 2)
    with pytest.raises(
        LinkUnavailableError, match=r"127\.0\.0\.2: Connection refused; 127\.0\.0\.2: Connection"
    ) as caught:
        open_tcp(TcpTarget("board.local", port))
    assert caught.value.reason.code == "connection_refused"
