"""`resonatord run` as a service manager hears it, by a socket that stands in for the manager's."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from emulation import emulated

from resonator_daemon.base.errors import ExitCode
from simulators.emulator import EmulatorOptions

START = "import sys; from resonator_daemon.commands import main; sys.exit(main())"
# The reader's thread stops for good in the midst of a stream, and three seconds without frames are too long: a busy
# computer makes it wait for less.
HANG = """
import threading
from resonator_daemon.daemon.monitoring import liveness
from resonator_daemon.board.session.board_reader import BoardReader
liveness._FRAMES_S = 3.0
read, left_bytes = BoardReader._read, [100_000]  # by then it measures

def read_or_hang(*a, **k):
    pieces = read(*a, **k)
    left_bytes[0] -= sum(len(piece.data) for piece in pieces)
    return pieces if left_bytes[0] > 0 else threading.Event().wait()

BoardReader._read = read_or_hang
"""


class Manager:
    """The far end of `NOTIFY_SOCKET`."""

    def __init__(self, directory: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(directory / "notify"))
        self.socket.settimeout(30)
        self.said: list[str] = []

    def hear(self) -> str:
        message = self.socket.recv(4096).decode()
        self.said += message.splitlines()
        return message

    def wait_for(self, wanted: Callable[[str], bool]) -> str:
        while not wanted(message := self.hear()):
            pass
        return message


@pytest.fixture
def manager(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Manager]:
    listening = Manager(tmp_path_factory.mktemp("m"))
    yield listening
    listening.socket.close()


@pytest.fixture
def start(manager: Manager, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start a daemon that the manager wants to hear of every 0.4 s."""
    started: list[subprocess.Popen[str]] = []

    def start(program: str = START, plate: str = "quartz16") -> subprocess.Popen[str]:
        config = tmp_path / "left.toml"
        config.write_text(f'name = "left"\nplate = "{plate}"\nlink = "serial:{tmp_path}/board?baud=4000000"\n')
        given = {"NOTIFY_SOCKET": manager.socket.getsockname(), "WATCHDOG_USEC": "400000"}
        process = subprocess.Popen(
            [sys.executable, "-c", program, "run", "--config", str(config)],
            env={**os.environ, **given},
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_ready_where_the_board_is_waited_for_then_alive_until_it_stops(
    manager: Manager, start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    process = start()
    ready = manager.wait_for(lambda message: "READY=1" in message)
    assert "link waiting: no port" in ready
    for _ in range(3):
        manager.wait_for(lambda message: "WATCHDOG=1" in message)
    with emulated(EmulatorOptions("quartz16", pty=tmp_path / "board", scenario="still")):
        manager.wait_for(lambda message: "frames/s" in message)
        for _ in range(3):
            manager.wait_for(lambda message: "WATCHDOG=1" in message)
        process.send_signal(signal.SIGHUP)
        manager.wait_for(lambda message: message.startswith("RELOADING=1\nMONOTONIC_USEC="))
        manager.wait_for(lambda message: "READY=1" in message)
        process.send_signal(signal.SIGTERM)
        manager.wait_for(lambda message: "STOPPING=1" in message)
        assert process.wait(30) == ExitCode.DONE


def test_a_reader_that_hangs_is_no_longer_called_alive(
    manager: Manager, start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    with emulated(EmulatorOptions("quartz16", pty=tmp_path / "board", scenario="still")):
        process = start(HANG + START)
        manager.wait_for(lambda message: "WATCHDOG=1" in message)
        assert process.stderr is not None
        for line in process.stderr:
            if "no frame was measured for" in line:
                break
        else:
            pytest.fail("it did not notice")
        manager.socket.setblocking(False)
        drain(manager)
        manager.said.clear()
        time.sleep(1.0)  # two and a half times what the manager would wait
        drain(manager)
        # It is fed five times a second; once here, where the manager's queue was full and that was still to be said.
        assert manager.said.count("WATCHDOG=1") <= 1


def drain(manager: Manager) -> None:
    while True:
        try:
            manager.hear()
        except BlockingIOError:
            return
