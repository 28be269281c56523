"""Notifications to a service manager, and log lines in the journal."""

import logging
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from resonator_daemon.base.host.systemd import JournalHandler, ServiceManager


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


@pytest.mark.parametrize("text", ["a\nREADY=1", "a\rREADY=1", "a\x1b[31mREADY=1", "a\u2028READY=1", "a\ud800READY=1"])
def test_a_text_of_others_stays_one_line(text: str, manager_socket: socket.socket) -> None:
    manager = ServiceManager(environment(manager_socket))
    manager.status(text)
    (message,) = heard(manager_socket)
    assert message.startswith("STATUS=a")
    assert message.isprintable()


@pytest.mark.parametrize(
    ("calls", "then"),
    [("reload ready", "READY=1\nSTATUS=lost\nWATCHDOG=1"), ("ready reload", "RELOADING=1\nMONOTONIC_USEC=")],
)
def test_a_full_queue_delays_what_is_said_last(manager_socket: socket.socket, calls: str, then: str) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as other:
        fill(other, manager_socket.getsockname())
    manager = ServiceManager(environment(manager_socket))
    for call in calls.split():
        manager.reloading() if call == "reload" else manager.ready("measuring")
    manager.status("lost")
    assert set(heard(manager_socket)) == {"X=1"}
    manager.alive()
    (message,) = heard(manager_socket)
    assert then in message
    assert ("READY=1" in message.splitlines()) == (calls == "reload ready")


@pytest.mark.parametrize("path", ["", "relative", "vsock:2:1234", "/nowhere/notify", "/" + "x" * 200])
def test_no_manager_is_no_error(path: str) -> None:
    manager = ServiceManager({"NOTIFY_SOCKET": path})
    manager.ready("")
    manager.reloading()
    manager.stopping()


def test_half_the_watchdogs_time(manager_socket: socket.socket) -> None:
    for own in ({}, {"WATCHDOG_PID": str(os.getpid())}):
        assert ServiceManager(environment(manager_socket, WATCHDOG_USEC="3000000", **own)).watchdog_s == 1.5


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


SCRIPT = """
import logging, sys
from pathlib import Path
from resonator_daemon.base.host import systemd as journal
journal.set_up_logging(logging.INFO, Path(sys.argv[1]))
journal.tag_log("left-index")
logging.getLogger("somewhere").warning("link %s", "lost", extra={"resonatord_link_state": "lost"})
logging.getLogger("somewhere").debug("unseen")
sys.stderr.write(journal.error_prefix() + "end\\n")
"""


class Elsewhere(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


@pytest.fixture
def elsewhere() -> Elsewhere:
    return Elsewhere()


@pytest.fixture
def handler(journal_socket: socket.socket, elsewhere: Elsewhere) -> Iterator[JournalHandler]:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    connection.connect(journal_socket.getsockname())
    made = JournalHandler(connection, elsewhere)
    yield made
    made.close()


@pytest.fixture
def journal_socket(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "journal"))
        listening.settimeout(20)
        yield listening


def line(message: str, level: int = logging.INFO) -> logging.LogRecord:
    name = "resonator_daemon.daemon.service.daemon"
    return logging.LogRecord(name, level, "/x/service.py", 7, message, (), None, "run")


def fields(datagram: bytes) -> dict[str, str]:
    """Parse a datagram, as journald does."""
    found = {}
    while datagram:
        head, datagram = datagram.split(b"\n", 1)
        if b"=" in head:
            name, value = head.split(b"=", 1)
        else:
            name, (size,) = head, struct.unpack("<Q", datagram[:8])
            value, end, datagram = datagram[8 : 8 + size], datagram[8 + size : 9 + size], datagram[9 + size :]
            assert end == b"\n"
        found[name.decode()] = value.decode()
    return found


def test_a_line_has_its_fields(handler: JournalHandler, journal_socket: socket.socket) -> None:
    handler.handle(line("frames flow"))
    assert fields(journal_socket.recv(1 << 20)) == {
        "MESSAGE": "frames flow", "PRIORITY": "6", "SYSLOG_IDENTIFIER": "resonatord", "CODE_FILE": "/x/service.py",
        "CODE_LINE": "7", "CODE_FUNC": "run", "RESONATORD_MODULE": "resonator_daemon.daemon.service.daemon",
        "RESONATORD_THREAD": "MainThread"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("said", "written"),
    [
        ("first\nPRIORITY=0\nlast", "first\nPRIORITY=0\nlast"),
        ("board:\x1b[31m\ud800 x\ty\x00 20 µs", r"board:\x1b[31m\ud800 x" + "\ty" + r"\x00 20 µs"),
    ],
)
def test_several_lines_stay_one_message_and_steer_no_terminal(
    handler: JournalHandler, journal_socket: socket.socket, said: str, written: str
) -> None:
    handler.handle(line(said))
    found = fields(journal_socket.recv(1 << 20))
    assert (found["MESSAGE"], found["PRIORITY"]) == (written, "6")


def test_a_full_journal_is_not_waited_for_and_what_is_lost_is_reported(
    handler: JournalHandler, elsewhere: Elsewhere, journal_socket: socket.socket
) -> None:
    for _ in range(1000):
        handler.handle(line("flood"))
    journal_socket.setblocking(False)
    taken = 0
    while True:
        try:
            assert "RESONATORD_LINES_LOST" not in fields(journal_socket.recv(1 << 20))
        except BlockingIOError:
            break
        taken += 1
    assert 0 < taken < 1000
    handler.handle(line("after the flood"))
    handler.handle(line("later"))
    after, later = (fields(journal_socket.recv(1 << 20)) for _ in range(2))
    assert after["RESONATORD_LINES_LOST"] == str(1000 - taken)
    assert "RESONATORD_LINES_LOST" not in later
    assert elsewhere.messages == []


def test_lines_of_a_journal_that_is_gone_go_to_stderr(
    handler: JournalHandler, elsewhere: Elsewhere, journal_socket: socket.socket
) -> None:
    journal_socket.close()
    handler.handle(line("still said"))
    assert elsewhere.messages == ["still said"]


def started(journal: Path, stream: str) -> str:
    """What a process says on stderr that systemd started with this JOURNAL_STREAM."""
    with open(journal.with_name("stderr"), "wb") as stderr:
        present = os.fstat(stderr.fileno())
        stream = stream.format(present=f"{present.st_dev}:{present.st_ino}")
        environment = {**os.environ, "JOURNAL_STREAM": stream}
        subprocess.run([sys.executable, "-c", SCRIPT, journal], stderr=stderr, env=environment, check=True)
    return journal.with_name("stderr").read_text()


def test_with_stderr_on_the_journal_lines_go_there_with_their_fields(journal_socket: socket.socket) -> None:
    assert started(Path(journal_socket.getsockname()), "{present}") == "<3>end\n"
    found = fields(journal_socket.recv(1 << 20))
    shown = {name: found[name] for name in ("MESSAGE", "PRIORITY", "RESONATORD_NAME", "RESONATORD_LINK_STATE")}
    assert shown == {
        "MESSAGE": "link lost",
        "PRIORITY": "4",
        "RESONATORD_NAME": "left-index",
        "RESONATORD_LINK_STATE": "lost",
    }
    journal_socket.setblocking(False)
    with pytest.raises(BlockingIOError):
        journal_socket.recv(1)


@pytest.mark.parametrize("stream", ["", "1:2", "nonsense"])
def test_a_stderr_elsewhere_gets_plain_lines(stream: str, journal_socket: socket.socket) -> None:
    assert started(Path(journal_socket.getsockname()), stream) == "WARNING link lost\nend\n"
