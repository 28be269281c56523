"""Opening serial ports, on pseudo-terminals: raw bytes, one holder at a time, and the reason of every refusal."""

import array
import errno
import fcntl
import grp
import os
import pty
import termios
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial
from serial.tools import list_ports

from resonator_daemon.acquisition import serial_link
from resonator_daemon.acquisition.link import FileDescriptorLink, LinkLostError, LinkUnavailableError
from resonator_daemon.acquisition.serial_link import open_serial
from resonator_daemon.config import SerialLink

BAUD = 4_000_000
AMPLE_S = 30.0
TIOCGEXCL = 0x80045440  # asks Linux whether TIOCEXCL holds
TCSETS2 = 0x402C542B  # sets a baud rate that has no constant


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


def refusal(path: str | Path, baud: int = BAUD) -> str:
    with pytest.raises(LinkUnavailableError) as raised:
        open_serial(SerialLink(str(path), baud))
    return str(raised.value)


def read_exactly(link: FileDescriptorLink, count: int) -> bytes:
    data = b""
    while len(data) < count:
        piece = link.read(AMPLE_S)
        assert piece, f"{len(data)} of {count} bytes came"
        data += piece
    return data


def failing_ioctl(request: int, code: int) -> Callable[..., Any]:
    """The real one, but for one request."""
    real = fcntl.ioctl

    def ioctl(descriptor: int, asked: int, *rest: Any) -> Any:
        if asked == request:
            raise OSError(code, os.strerror(code))
        return real(descriptor, asked, *rest)

    return ioctl


@pytest.mark.parametrize("baud", [115_200, BAUD, 2_345_678])
def test_every_byte_value_passes_unchanged_both_ways(port: Terminal, baud: int) -> None:
    every_byte = bytes(range(256))
    link = open_serial(SerialLink(port.path, baud))
    os.write(port.master, every_byte)
    assert read_exactly(link, 256) == every_byte
    link.write(every_byte)
    assert os.read(port.master, 1000) == every_byte  # and nothing was echoed before it
    link.close()


def test_an_open_port_is_silent_without_waiting_and_tells_a_hang_up(port: Terminal) -> None:
    link = open_serial(SerialLink(port.path, BAUD))
    assert link.read(0.0) == b""
    port.hang_up()
    with pytest.raises(LinkLostError, match="unplugged"):
        link.read(AMPLE_S)
    link.close()
    link.close()  # never fails, on a port that is gone and closed either


def test_a_port_is_kept_from_programs_that_do_not_ask_while_it_is_open(port: Terminal) -> None:
    exclusive = array.array("i", [0])
    link = open_serial(SerialLink(port.path, BAUD))
    fcntl.ioctl(port.slave, TIOCGEXCL, exclusive)
    assert exclusive[0] == 1
    link.close()
    fcntl.ioctl(port.slave, TIOCGEXCL, exclusive)
    assert exclusive[0] == 0


def test_closing_never_fails(port: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    link = open_serial(SerialLink(port.path, BAUD))
    close = serial.Serial.close

    def close_late(closed: serial.Serial) -> None:
        close(closed)
        raise OSError(errno.EIO, os.strerror(errno.EIO))  # as a driver may say whose device is gone

    with monkeypatch.context() as patched:
        patched.setattr(serial.Serial, "close", close_late)
        link.close()


def test_closing_twice_leaves_the_port_of_the_next_holder_alone(port: Terminal) -> None:
    first = open_serial(SerialLink(port.path, BAUD))
    first.close()
    second = open_serial(SerialLink(port.path, BAUD))  # takes over the descriptor's number
    first.close()
    exclusive = array.array("i", [0])
    fcntl.ioctl(port.slave, TIOCGEXCL, exclusive)
    assert exclusive[0] == 1
    second.close()


def test_a_busy_port_is_said_to_be_held_and_opens_once_it_is_free(port: Terminal) -> None:
    held = open_serial(SerialLink(port.path, BAUD))
    said = refusal(port.path)
    assert port.path in said
    assert "held by another program" in said
    held.close()
    open_serial(SerialLink(port.path, BAUD)).close()


def test_a_locked_port_is_said_to_be_held(port: Terminal) -> None:
    fcntl.flock(port.slave, fcntl.LOCK_EX)
    assert "held by another program" in refusal(port.path)
    fcntl.flock(port.slave, fcntl.LOCK_UN)
    open_serial(SerialLink(port.path, BAUD)).close()


def ports_present(monkeypatch: pytest.MonkeyPatch, root: Path, devices: tuple[str, ...] = ()) -> Path:
    """Let the machine have these ports, and a directory of ports by id, which is returned."""
    monkeypatch.setattr(serial_link, "Path", lambda path: root / path.lstrip("/"))
    present = [SimpleNamespace(device=device) for device in devices]
    monkeypatch.setattr(list_ports, "comports", lambda: present)
    by_id = root / "dev/serial/by-id"
    by_id.mkdir(parents=True)
    return by_id


def test_a_missing_port_is_said_with_those_present(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    by_id = ports_present(monkeypatch, tmp_path, ("/dev/ttyUSB1", "/dev/ttyACM0"))
    missing = tmp_path / "ttyACM9"
    assert refusal(missing) == f"no port {missing}; present: /dev/ttyACM0, /dev/ttyUSB1"
    for name in ("usb-RD_board_0043-if00", "usb-RD_board_0042-if00"):
        (by_id / name).touch()
    boards = f"{by_id}/usb-RD_board_0042-if00, {by_id}/usb-RD_board_0043-if00"
    assert refusal(missing) == f"no port {missing}; present: {boards}"


def test_a_machine_without_ports_is_said_to_have_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ports_present(monkeypatch, tmp_path)
    assert refusal(tmp_path / "ttyACM9").endswith("no serial port is present")


def test_a_link_that_points_nowhere_is_a_missing_port(tmp_path: Path) -> None:
    link = tmp_path / "board"
    link.symlink_to(tmp_path / "pts-that-is-gone")
    assert refusal(link).startswith(f"no port {link}; ")


def test_a_path_through_a_file_is_a_missing_port(tmp_path: Path) -> None:
    (tmp_path / "dev").touch()
    assert refusal(tmp_path / "dev" / "ttyACM0").startswith(f"no port {tmp_path}/dev/ttyACM0; ")


def test_a_port_that_is_back_already_was_missing(tmp_path: Path) -> None:
    error = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
    assert serial_link._why_not(SerialLink(str(tmp_path), BAUD), error).startswith(f"no port {tmp_path}; ")


@pytest.mark.parametrize("make", [Path.touch, os.mkfifo])
def test_a_file_that_is_no_terminal_is_said_to_be_no_serial_port(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "notes.txt"
    make(path)
    said = refusal(path)
    assert said.startswith(f"{path} is no serial port; ")
    assert "present" in said


def test_a_directory_is_refused_with_its_error(tmp_path: Path) -> None:
    assert "cannot be opened" in (said := refusal(tmp_path))
    assert os.strerror(errno.EISDIR) in said


def test_a_rate_that_the_driver_refuses_is_said(port: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(fcntl, "ioctl", failing_ioctl(TCSETS2, errno.EINVAL))
        said = refusal(port.path, 2_345_678)
    assert said.startswith(f"{port.path} cannot be set to 2345678 baud")
    open_serial(SerialLink(port.path, BAUD)).close()  # the failure left no lock behind


@pytest.mark.parametrize("code", [errno.EACCES, errno.EPERM])
def test_a_port_that_is_not_permitted_names_the_group_to_join(tmp_path: Path, code: int) -> None:
    path = tmp_path / "ttyACM0"
    path.touch()
    said = serial_link._why_not(SerialLink(str(path), BAUD), PermissionError(code, os.strerror(code)))
    group = grp.getgrgid(path.stat().st_gid).gr_name
    assert said == f"{path} may not be opened by this user; join the group {group}"


def test_a_group_without_a_name_is_named_by_its_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nameless(number: int) -> None:
        raise KeyError(f"getgrgid(): gid not found: {number}")

    path = tmp_path / "ttyACM0"
    path.touch()
    monkeypatch.setattr(grp, "getgrgid", nameless)
    said = serial_link._why_not(SerialLink(str(path), BAUD), PermissionError(errno.EACCES, "Permission denied"))
    assert said.endswith(f"join the group {path.stat().st_gid}")


def test_a_port_that_goes_away_while_it_is_set_up_is_no_crash(port: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(_descriptor: int, _queue: int) -> None:
        raise termios.error(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(termios, "tcflush", gone)
    assert os.strerror(errno.EIO) in refusal(port.path)


def test_a_port_that_goes_away_at_the_last_moment_is_given_back(
    port: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(fcntl, "ioctl", failing_ioctl(termios.TIOCEXCL, errno.EIO))
        assert f"{port.path} went away" in refusal(port.path)
    open_serial(SerialLink(port.path, BAUD)).close()
