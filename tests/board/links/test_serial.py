"""Opening serial ports, on pseudo-terminals: raw bytes, one holder at a time, and the reason of every refusal."""

import array
import errno
import fcntl
import grp
import os
import pty
import struct
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial

from resonator_daemon.base.host.text import page
from resonator_daemon.base.reasons import Reason
from resonator_daemon.board.links.carriers import serial as serial_link
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.links.link import LinkUnavailableError

DENIED = "permission_denied"
BAUD = 4_000_000
TIOCGEXCL = 0x80045440  # asks Linux whether TIOCEXCL holds
TCSETS2 = 0x402C542B  # sets a baud rate that has no constant
TCGETS2 = 0x802C542A
TIOCGICOUNT = 0x545D


class Terminal:
    """A pseudo-terminal in the place of a board's port."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        self.path = os.ttyname(self.slave)

    def hang_up(self) -> None:
        os.close(self.master)
        self.master = -1

    def close(self) -> None:
        for descriptor in (self.master, self.slave):
            if descriptor >= 0:
                os.close(descriptor)


@pytest.fixture
def port() -> Iterator[Terminal]:
    terminal = Terminal()
    yield terminal
    terminal.close()


def refusal(path: str | Path, baud: int = BAUD) -> Reason:
    with pytest.raises(LinkUnavailableError) as raised:
        SerialTarget(str(path), baud).open()
    return raised.value.reason


@contextmanager
def open_elsewhere(path: str) -> Iterator[int]:
    """Let another process have the port open, without a lock, for as long as the context lasts; yield its id."""
    program = f"import os; os.open({path!r}, os.O_RDWR | os.O_NOCTTY); print('held', flush=True); os.read(0, 1)"
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        yield holder.pid


def test_a_port_is_kept_from_programs_that_do_not_ask_while_it_is_open(port: Terminal) -> None:
    exclusive = array.array("i", [0])
    link = SerialTarget(port.path, BAUD).open()
    fcntl.ioctl(port.slave, TIOCGEXCL, exclusive)
    assert exclusive[0] == 1
    link.close()
    fcntl.ioctl(port.slave, TIOCGEXCL, exclusive)
    assert exclusive[0] == 0


def test_a_busy_port_is_said_to_be_held_and_opens_once_it_is_free(port: Terminal) -> None:
    held = SerialTarget(port.path, BAUD).open()
    code, said = refusal(port.path)
    assert code == "port_in_use"
    assert f"(pid {os.getpid()})" in said
    held.close()
    SerialTarget(port.path, BAUD).open().close()


def test_a_port_that_another_program_holds_unlocked_is_not_shared(
    port: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_link, "is_pseudo_terminal", lambda _path: False)
    with open_elsewhere(port.path) as pid:
        code, said = refusal(port.path)
        assert code == "port_in_use"
        assert f"(pid {pid})" in said
    SerialTarget(port.path, BAUD).open().close()  # this process's own hold counts for nothing


def test_closing_leaves_the_modem_lines_as_they_are(port: Terminal) -> None:
    settings = termios.tcgetattr(port.slave)
    settings[2] |= termios.HUPCL
    termios.tcsetattr(port.slave, termios.TCSANOW, settings)
    link = SerialTarget(port.path, 2_345_678).open()
    assert not termios.tcgetattr(port.slave)[2] & termios.HUPCL
    settings2 = bytearray(44)
    fcntl.ioctl(port.slave, TCGETS2, settings2)
    assert struct.unpack_from("II", settings2, 36) == (2_345_678, 2_345_678)  # the rate without a constant stayed
    link.close()


def test_nothing_that_came_before_is_read_or_sent_back(port: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    real = termios.tcflush
    flushed = []

    def flush(descriptor: int, queue: int) -> None:
        flushed.append(queue)  # of a terminal that is not raw, output holds an echo; a pseudo-terminal's goes at once
        real(descriptor, queue)

    monkeypatch.setattr(termios, "tcflush", flush)
    os.write(port.master, b"frames of an old run\n")
    link = SerialTarget(port.path, BAUD).open()
    assert link.read(0.0) == b""
    assert flushed == [termios.TCIFLUSH, termios.TCOFLUSH]
    link.close()


@pytest.mark.parametrize(("queued", "dropped"), [([28, 5, 0], []), ([28] * 3, [termios.TCOFLUSH])])
def test_closing_waits_a_moment_for_a_board_to_take_the_last_bytes(
    port: Terminal, monkeypatch: pytest.MonkeyPatch, queued: list[int], dropped: list[int]
) -> None:
    real = fcntl.ioctl
    flushed: list[int] = []
    instants = iter((0.0, 0.04, 0.049, 0.05))  # at the fourth it has been a moment

    def stuck(descriptor: int, asked: int, *rest: Any) -> Any:
        if asked == termios.TIOCOUTQ:
            rest[0][0] = queued.pop(0)
            return 0
        return real(descriptor, asked, *rest)

    link = SerialTarget(port.path, BAUD).open()
    monkeypatch.setattr(fcntl, "ioctl", stuck)
    clock = SimpleNamespace(monotonic=lambda: next(instants), sleep=lambda _s: None)
    monkeypatch.setattr(serial_link, "time", clock)
    monkeypatch.setattr(termios, "tcflush", lambda _descriptor, queue: flushed.append(queue))
    link.close()
    assert flushed == dropped
    assert not queued


@pytest.mark.parametrize("has_such_a_mode", [True, False])
def test_low_latency_mode_is_requested(port: Terminal, monkeypatch: pytest.MonkeyPatch, has_such_a_mode: bool) -> None:
    asked = []

    def low_latency(_port: serial.Serial, mode: bool) -> None:
        asked.append(mode)
        if not has_such_a_mode:
            raise ValueError("Failed to update ASYNC_LOW_LATENCY flag")

    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", low_latency)
    SerialTarget(port.path, BAUD).open().close()
    assert asked == [True]


def test_losses_of_the_driver_are_counted_from_the_opening_on(port: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    real = fcntl.ioctl
    overrun, buffer_overrun = 2**31 - 1, 5
    gone = False

    def counting(descriptor: int, asked: int, *rest: Any) -> Any:
        if asked != TIOCGICOUNT:
            return real(descriptor, asked, *rest)
        if gone:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        struct.pack_into("11i", rest[0], 0, 1, 2, 3, 4, 5, 6, 7, overrun, 8, 9, buffer_overrun)
        return 0

    monkeypatch.setattr(fcntl, "ioctl", counting)
    link = SerialTarget(port.path, BAUD).open()
    assert link.overruns == 0
    overrun, buffer_overrun = -(2**31) + 1, 8  # two more, past the end of the driver's number, and three more
    assert link.overruns == 5
    gone = True
    assert link.overruns == 5
    gone, buffer_overrun = False, 100
    link.close()
    assert link.overruns == 5  # nobody asks a descriptor that may be another's


@pytest.mark.parametrize("make", [Path.touch, os.mkfifo, Path.mkdir])
def test_a_file_that_is_no_terminal_is_said_to_be_no_serial_port(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "notes.txt"
    make(path)
    code, said = refusal(path)
    assert (code, said.startswith(f"{path} is no serial port; ")) == ("port_unusable", True)
    assert "present" in said


@pytest.mark.parametrize(
    ("number", "code", "group", "remedy"),
    [
        (errno.EACCES, DENIED, "dialout", "join its group: sudo usermod -aG dialout $USER, then log in again"),
        (errno.EPERM, DENIED, "dialout", "join its group: sudo usermod -aG dialout $USER, then log in again"),
        (errno.EACCES, DENIED, "root", f"a udev rule ({page('how-to/connect.md')})"),
        (errno.EACCES, DENIED, None, f"a udev rule ({page('how-to/connect.md')})"),
        (errno.EMFILE, "port_unusable", None, os.strerror(errno.EMFILE)),
        (errno.ENXIO, "no_such_port", None, f"({os.strerror(errno.ENXIO)}); plug it in"),
    ],
)
def test_why_a_port_cannot_be_opened_is_said_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, code: str, group: str | None, remedy: str
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(number, f"could not open port: [Errno {number}] {os.strerror(number)}: 'x'")

    def named(group_id: int) -> SimpleNamespace:
        if group is None:
            raise KeyError(f"getgrgid(): gid not found: {group_id}")
        return SimpleNamespace(gr_name=group)

    path = tmp_path / "ttyACM0"
    path.touch()
    monkeypatch.setattr(grp, "getgrgid", named)
    monkeypatch.setattr(serial, "Serial", refuse)
    found, said = refusal(path)
    assert (found, said.startswith(f"{path} ")) == (code, True)
    assert said.endswith(remedy)
    assert f"Errno {number}" not in said


def test_a_rate_that_the_driver_refuses_is_said(port: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    real = fcntl.ioctl

    def refusing(descriptor: int, asked: int, *rest: Any) -> Any:
        if asked == TCSETS2:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return real(descriptor, asked, *rest)

    with monkeypatch.context() as patched:
        patched.setattr(fcntl, "ioctl", refusing)
        reason = refusal(port.path, 2_345_678)
    assert reason.code == "port_unusable"
    assert reason.text.startswith(f"{port.path} cannot be set to 2345678 baud")
    SerialTarget(port.path, BAUD).open().close()  # the failure left no lock behind
