"""Connecting over TCP on the loopback: bytes both ways, peers that misbehave, nobody there; names to addresses."""

import contextlib
import ctypes
import socket
import struct
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from resonator_daemon.board.links.carriers import tcp as tcp_link
from resonator_daemon.board.links.carriers.tcp import TcpTarget, open_tcp, resolve_host
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
    with pytest.raises(LinkUnavailableError) as caught:
        open_tcp(TcpTarget("board.local", port))
    assert caught.value.reason.code == "connection_refused"


class Resolver:
    """Answers when it is let."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.go_on = threading.Event()
        self.error: Exception | None = None

    def getaddrinfo(self, host: str, port: int, **_: Any) -> list[Any]:
        self.asked.append(host)
        self.go_on.wait(AMPLE_S)
        if self.error is not None:
            raise self.error
        return [(socket.AF_INET6, socket.SOCK_STREAM, 6, "", ("fe80::1", port, 0, 3))]


@pytest.fixture
def resolver(monkeypatch: pytest.MonkeyPatch) -> Iterator[Resolver]:
    resolver = Resolver()
    monkeypatch.setattr(tcp_link, "socket", resolver)
    monkeypatch.setattr(resolver, "SOCK_STREAM", socket.SOCK_STREAM, raising=False)
    yield resolver
    resolver.go_on.set()


def test_an_answer_that_is_late_serves_the_next_question(resolver: Resolver) -> None:
    for _ in range(3):
        with pytest.raises(TimeoutError, match=r"its name was not found within 0\.01 s"):
            resolve_host("slow.local", 5000, 0.01)
    resolver.go_on.set()
    assert resolve_host("slow.local", 5000, AMPLE_S) == [(socket.AF_INET6, ("fe80::1", 5000, 0, 3))]
    assert resolver.asked == ["slow.local"]
    resolve_host("slow.local", 5000, AMPLE_S)  # answers are not kept: an address may change
    assert resolver.asked == ["slow.local"] * 2


def test_an_error_is_told_once_and_the_name_asked_anew(resolver: Resolver) -> None:
    resolver.go_on.set()
    resolver.error = ValueError("embedded null character")
    with pytest.raises(ValueError, match="embedded"):
        resolve_host("none.local", 5000, AMPLE_S)
    resolver.error = None
    resolve_host("none.local", 5000, AMPLE_S)
