import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from resonator_daemon.base.host.systemd import ServiceManager


@pytest.fixture
def manager_socket(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        yield listening


def heard(listening: socket.socket) -> list[str]:
    messages = []
    while True:
        try:
            messages.append(listening.recv(4096).decode())
        except BlockingIOError:
            return messages


def fill(sending: socket.socket, path: str) -> None:
    while True:
        try:
            sending.sendto(b"X=1", path)
        except BlockingIOError:
            return


def environment(listening: socket.socket, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": listening.getsockname(), **more}


def test_each_message_as_the_manager_reads_it(manager_socket: socket.socket) -> None:
    manager = ServiceManager(environment(manager_socket))
    manager.ready("left: measuring")
    manager.alive()
    manager.status("left: waiting")
    manager.status("left: waiting")
    manager.stopping()
    assert heard(manager_socket) == [
        "READY=1\nSTATUS=left: measuring",
        "WATCHDOG=1",
        "STATUS=left: waiting",
        "STOPPING=1",
    ]


def test_a_reload_tells_when_it_began(manager_socket: socket.socket) -> None:
    manager = ServiceManager(environment(manager_socket))
    before_us = time.monotonic_ns() // 1000
    manager.reloading()
    after_us = time.monotonic_ns() // 1000
    manager.ready("measuring")
    reloading, ready = heard(manager_socket)
    name, began_us = reloading.splitlines()[1].split("=")
    assert (reloading.splitlines()[0], name, ready) == ("RELOADING=1", "MONOTONIC_USEC", "READY=1\nSTATUS=measuring")
    assert before_us <= int(began_us) <= after_us


@pytest.mark.parametrize("text", ["a\nREADY=1", "a\rREADY=1", "a\x1b[31mREADY=1", "a\u2028READY=1", "a\ud800READY=1"])
def test_a_text_of_others_stays_one_line(text: str, manager_socket: socket.socket) -> None:
    manager = ServiceManager(environment(manager_socket))
    manager.status(text)
    (message,) = heard(manager_socket)
    assert message.startswith("STATUS=a")
    assert message.isprintable()


def test_a_full_queue_delays_what_is_said(manager_socket: socket.socket) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as other:
        fill(other, manager_socket.getsockname())
    manager = ServiceManager(environment(manager_socket))
    manager.reloading()
    manager.ready("measuring")
    manager.status("lost")
    assert set(heard(manager_socket)) == {"X=1"}
    manager.alive()
    assert heard(manager_socket) == ["READY=1\nSTATUS=lost\nWATCHDOG=1"]


def test_a_reload_that_begins_late_does_not_end_early(manager_socket: socket.socket) -> None:
    manager = ServiceManager({"NOTIFY_SOCKET": manager_socket.getsockname()})
    Path(manager_socket.getsockname()).rename(f"{manager_socket.getsockname()}.away")
    manager.ready("measuring")
    manager.reloading()
    Path(f"{manager_socket.getsockname()}.away").rename(manager_socket.getsockname())
    manager.alive()
    (message,) = heard(manager_socket)
    assert "READY=1" not in message.splitlines()
    assert "RELOADING=1" in message.splitlines()


@pytest.mark.parametrize("path", ["", "relative", "vsock:2:1234", "/nowhere/notify", "/" + "x" * 200])
def test_no_manager_is_no_error(path: str) -> None:
    manager = ServiceManager({"NOTIFY_SOCKET": path})
    manager.ready("")
    manager.reloading()
    manager.stopping()


def test_half_the_watchdogs_time(manager_socket: socket.socket) -> None:
    assert ServiceManager(environment(manager_socket, WATCHDOG_USEC="3000000")).watchdog_s == 1.5
    own = environment(manager_socket, WATCHDOG_USEC="3000000", WATCHDOG_PID=str(os.getpid()))
    assert ServiceManager(own).watchdog_s == 1.5


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"NOTIFY_SOCKET": "", "WATCHDOG_USEC": "3000000"},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"},
    ],
)
def test_nobody_watches(given: dict[str, str], manager_socket: socket.socket) -> None:
    assert ServiceManager(environment(manager_socket, **given)).watchdog_s is None
