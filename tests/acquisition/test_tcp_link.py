"""Connecting over TCP on the loopback: bytes both ways, nobody there, names that no host can have."""

import os
import socket
from collections.abc import Iterator

import pytest

from resonator_daemon.acquisition.link import LinkLostError, LinkUnavailableError
from resonator_daemon.acquisition.tcp_link import open_tcp
from resonator_daemon.config import TcpLink

AMPLE_S = 30.0


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(AMPLE_S)
        yield listener


def target(listener: socket.socket) -> TcpLink:
    return TcpLink("127.0.0.1", listener.getsockname()[1])


def test_bytes_pass_both_ways_until_either_end_closes(listener: socket.socket) -> None:
    link = open_tcp(target(listener))
    board, _ = listener.accept()
    with board:
        board.settimeout(AMPLE_S)
        board.sendall(b"frame")
        assert link.read(AMPLE_S) == b"frame"
        link.write(b"start")
        assert board.recv(100) == b"start"
    with pytest.raises(LinkLostError):
        link.read(AMPLE_S)
    link.close()


def test_closing_ends_the_connection(listener: socket.socket) -> None:
    link = open_tcp(target(listener))
    board, _ = listener.accept()
    with board:
        board.settimeout(AMPLE_S)
        link.close()
        assert board.recv(1) == b""


def test_the_socket_never_blocks_and_sends_at_once(listener: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    create = socket.create_connection

    def remembered(*arguments: object, **options: object) -> socket.socket:
        made.append(create(*arguments, **options))  # type: ignore[arg-type]
        return made[-1]

    monkeypatch.setattr(socket, "create_connection", remembered)
    link = open_tcp(target(listener))
    assert not os.get_blocking(made[0].fileno())
    assert made[0].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    link.close()


def test_nobody_there_is_said_with_the_address(listener: socket.socket) -> None:
    where = target(listener)
    listener.close()
    with pytest.raises(LinkUnavailableError, match=rf"tcp://127\.0\.0\.1:{where.port} .*refused"):
        open_tcp(where)


@pytest.mark.parametrize("host", ["left..finger", "x" * 70])
def test_a_name_that_no_host_can_have_is_no_crash(host: str) -> None:
    with pytest.raises(LinkUnavailableError, match=f"tcp://{host}:5000 does not answer"):
        open_tcp(TcpLink(host, 5000))
