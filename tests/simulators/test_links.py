"""The emulator's links against the system's own pseudo-terminals and sockets."""

import os
import select
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config import load_config
from simulators.links import PtyLink, TcpLink

WAIT_S = 5.0


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[tuple[PtyLink, Path]]:
    path = tmp_path / "board"
    link = PtyLink(path)
    yield link, path
    link.close()


def connect(link: TcpLink) -> socket.socket:
    host, port = link.address.removeprefix("tcp://").rsplit(":", 1)
    client = socket.create_connection((host, int(port)), timeout=WAIT_S)
    while link.write_fd is None:
        assert select.select(link.read_fds, [], [], WAIT_S)[0]
        link.read()
    return client


def test_a_host_that_does_not_read_never_blocks_the_board(pty: tuple[PtyLink, Path]) -> None:
    link, path = pty
    host_fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    taken = 0
    while written := link.write(bytes(4096)):
        taken += written
    assert 1000 < taken < 1_000_000
    received = 0
    while received < taken:
        received += len(os.read(host_fd, 65536))
    os.close(host_fd)
    assert link.write_fd is not None
    assert select.select([], [link.write_fd], [], WAIT_S)[1]
    assert link.write(b"x") == 1


@pytest.mark.parametrize("served", [False, True])
def test_another_client_is_served_in_place_of_the_first_or_closed(served: bool) -> None:
    decisions = iter((True, served))
    link = TcpLink("127.0.0.1", 0, lambda: next(decisions))
    host, port = link.address.removeprefix("tcp://").rsplit(":", 1)
    with connect(link) as first, socket.create_connection((host, int(port)), timeout=WAIT_S) as second:
        assert select.select(link.read_fds, [], [], WAIT_S)[0]
        assert link.read() == b""
        link.write(b"on")
        kept, closed = (second, first) if served else (first, second)
        assert (closed.recv(1), kept.recv(2)) == (b"", b"on")
    link.close()


def test_the_address_of_a_terminal_has_a_rate_that_carries_the_plate(tmp_path: Path) -> None:
    plate = load_plate("skin32")
    link = PtyLink(tmp_path / "skin", 10 * plate.frame_bytes * plate.counter.frame_rate_hz)
    configuration = tmp_path / "skin.toml"
    configuration.write_text(f'plate = "skin32"\nlink = "{link.address}"\n')
    assert load_config(configuration).link is not None
    link.close()
