"""The link over a file descriptor, on socket pairs and pseudo-terminals: bytes, silence, hang-ups, deaf peers."""

import errno
import os
import pty
import socket
import threading
import tty
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from resonator_daemon.board.links import link as link_module
from resonator_daemon.board.links.link import FileDescriptorLink, LinkLostError

AMPLE_S = 20.0  # to wait for what must come: ends a test that hangs


class Pair:
    """A link over one end of a socket pair, and the other end."""

    def __init__(self) -> None:
        self.near, self.far = socket.socketpair()
        self.near.setblocking(False)
        self.far.settimeout(AMPLE_S)
        self.link = FileDescriptorLink(self.near.fileno(), self.near.close)

    def close(self) -> None:
        self.near.close()
        self.far.close()


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = Pair()
    yield pair
    pair.close()


def test_the_last_bytes_come_before_the_end_of_the_stream(pair: Pair) -> None:
    pair.far.sendall(b"last words")
    pair.far.close()
    assert pair.link.read(AMPLE_S) == b"last words"
    with pytest.raises(LinkLostError, match="end of stream"):
        pair.link.read(AMPLE_S)


def test_write_sends_all_in_order_through_a_small_buffer(pair: Pair) -> None:
    data = bytes(range(251)) * 8000  # 2 MB, of a period that no buffer size divides
    pair.near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    received = bytearray()

    def take() -> None:
        while len(received) < len(data) and (piece := pair.far.recv(65536)):
            received.extend(piece)

    taker = threading.Thread(target=take)
    taker.start()
    try:
        pair.link.write(data)
    except LinkLostError:
        pair.near.close()  # which ends the taker
        raise
    finally:
        taker.join()
    assert received == data


def test_write_to_a_peer_that_takes_nothing_ends(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "WRITE_TIMEOUT_S", 0.05)
    with pytest.raises(LinkLostError, match=r"accepted no bytes for 0\.05 s"):
        pair.link.write(bytes(8 << 20))


def test_write_ends_where_a_writable_descriptor_takes_nothing(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_descriptor: int, _data: bytes) -> int:
        raise BlockingIOError

    monkeypatch.setattr(link_module, "WRITE_TIMEOUT_S", 0.05)
    monkeypatch.setattr(link_module, "os", SimpleNamespace(write=refuse))
    with pytest.raises(LinkLostError, match="accepted no bytes"):
        pair.link.write(b"ping")


def test_what_a_terminal_gives_in_pieces_comes_in_one_read() -> None:
    master, slave = pty.openpty()
    for descriptor in (master, slave):
        tty.setraw(descriptor)
        os.set_blocking(descriptor, False)
    data = bytes(range(251)) * 36  # 9 kB, of which a terminal gives 4 kB a call
    link = FileDescriptorLink(slave, lambda: os.close(slave))
    most_bytes = 0
    for _ in range(20):  # now and then the kernel hands on a few bytes only, behind which there are more
        assert os.write(master, data) == len(data)
        received = link.read(AMPLE_S)
        most_bytes = max(most_bytes, len(received))
        while len(received) < len(data):
            received += link.read(AMPLE_S)
        assert received == data
    link.close()
    os.close(master)
    assert most_bytes > 8192


def test_an_error_behind_bytes_is_told_after_them_and_every_time(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[int | OSError] = [4096, OSError(errno.ECONNRESET, os.strerror(errno.ECONNRESET))]

    def reset(_descriptor: int, _buffers: object) -> int:
        answer = answers.pop(0)  # the system tells of a reset once
        if isinstance(answer, OSError):
            raise answer
        return answer

    pair.far.sendall(b"ready")
    monkeypatch.setattr(link_module, "os", SimpleNamespace(readv=reset))
    assert len(pair.link.read(AMPLE_S)) == 4096
    for _ in range(2):
        with pytest.raises(LinkLostError, match="Connection reset by peer"):
            pair.link.read(AMPLE_S)


def test_a_descriptor_that_hung_up_is_a_loss_and_no_busy_loop(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(_descriptor: int, _buffers: object) -> int:
        raise BlockingIOError

    pair.far.close()
    monkeypatch.setattr(link_module, "os", SimpleNamespace(readv=nothing))
    with pytest.raises(LinkLostError, match="hung up"):
        pair.link.read(AMPLE_S)


def test_a_closed_link_is_lost_whoever_has_its_descriptor_now(pair: Pair) -> None:
    number = pair.near.fileno()
    pair.link.close()
    os.dup2(pair.far.fileno(), number)
    try:
        for use in (lambda: pair.link.read(0.0), lambda: pair.link.write(b"stop")):
            with pytest.raises(LinkLostError, match="closed here"):
                use()
        pair.link.close()
        os.fstat(number)  # is not closed a second time
    finally:
        os.close(number)
