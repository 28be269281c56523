"""The emulator's links against the system's own pseudo-terminals and sockets."""

import os
import select
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from resonator_daemon.config import load_config
from resonator_daemon.plate import load_plate
from simulators.links import PtyLink, TcpLink

WAIT_S = 5.0


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[tuple[PtyLink, Path]]:
    path = tmp_path / "board"
    link = PtyLink(path)
    yield link, path
    link.close()


@pytest.fixture
def tcp() -> Iterator[TcpLink]:
    link = TcpLink("127.0.0.1", 0)
    yield link
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


def test_a_client_that_vanished_gives_way_to_another() -> None:
    now = [100.0]
    link = TcpLink("127.0.0.1", 0, clock=lambda: now[0])
    host, port = link.address.removeprefix("tcp://").rsplit(":", 1)
    with connect(link) as first, ExitStack() as stack:
        first.sendall(b"a")
        assert select.select(link.read_fds[1:], [], [], WAIT_S)[0]
        assert link.read() == b"a"
        for silent_s, served in ((9.9, False), (0.2, True)):
            now[0] += silent_s
            second = stack.enter_context(socket.create_connection((host, int(port)), timeout=WAIT_S))
            assert select.select(link.read_fds, [], [], WAIT_S)[0]
            assert link.read() == b""
            assert (link.write_fd is None) is served  # in between nobody is: what was queued ends with the first
            if not served:
                assert second.recv(1) == b""
        link.read()
        link.write(b"on")
        assert (first.recv(1), second.recv(2)) == (b"", b"on")
    link.close()


def test_the_address_of_a_terminal_has_a_rate_that_carries_the_plate(tmp_path: Path) -> None:
    plate = load_plate("skin32")
    link = PtyLink(tmp_path / "skin", 10 * plate.frame_bytes * plate.counter.frame_rate_hz)
    configuration = tmp_path / "skin.toml"
    configuration.write_text(f'plate = "skin32"\nlink = "{link.address}"\n')
    assert load_config(configuration).link is not None
    link.close()
