"""Names to addresses: an answer that comes too late serves the next question, and there is one question at a time."""

import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from resonator_daemon.board.links.carriers import tcp as port_lookup
from resonator_daemon.board.links.carriers.tcp import resolve_host

AMPLE_S = 20.0


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
    monkeypatch.setattr(port_lookup, "socket", resolver)
    monkeypatch.setattr(resolver, "SOCK_STREAM", socket.SOCK_STREAM, raising=False)
    yield resolver
    resolver.go_on.set()


def test_families_and_addresses_are_returned(resolver: Resolver) -> None:
    resolver.go_on.set()
    assert resolve_host("board.local", 5000, AMPLE_S) == [(socket.AF_INET6, ("fe80::1", 5000, 0, 3))]


def test_an_answer_that_is_late_serves_the_next_question(resolver: Resolver) -> None:
    for _ in range(3):
        with pytest.raises(TimeoutError, match=r"its name was not found within 0\.01 s"):
            resolve_host("slow.local", 5000, 0.01)
    resolver.go_on.set()
    assert resolve_host("slow.local", 5000, AMPLE_S)[0][1][0] == "fe80::1"
    assert resolver.asked == ["slow.local"]
    resolve_host("slow.local", 5000, AMPLE_S)  # answers are not kept: an address may change
    assert resolver.asked == ["slow.local"] * 2


@pytest.mark.parametrize(
    "error",
    [socket.gaierror(-2, "Name or service not known"), TimeoutError("resolver"), ValueError("embedded null character")],
)
def test_an_error_is_told_once_and_the_name_asked_anew(resolver: Resolver, error: Exception) -> None:
    resolver.go_on.set()
    resolver.error = error
    with pytest.raises(type(error)) as raised:
        resolve_host("none.local", 5000, AMPLE_S)
    assert raised.value is error
    resolver.error = None
    resolve_host("none.local", 5000, AMPLE_S)
