"""Adapters behind serial ports: the same one under another name, and the latency timer of one that collects bytes."""

import errno
import logging
import os
from pathlib import Path
from typing import Any

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from resonator_daemon.board.links.carriers.serial import (
    PortIdentity,
    find_port,
    port_identity,
    serial_ports,
    shorten_latency_timer,
)

BOARD = PortIdentity(0x1209, 0x0002, "0042", "1.0")
GONE = "/dev/ttyACM9"  # as configured, and not there


def port(device: str, **attributes: Any) -> ListPortInfo:
    info = ListPortInfo(device)
    said = {"vid": 0x1209, "pid": 0x0002, "serial_number": "0042", "location": "1-1:1.0"} | attributes
    for name, value in said.items():
        setattr(info, name, value)
    return info


@pytest.fixture
def present(monkeypatch: pytest.MonkeyPatch) -> list[ListPortInfo]:
    """The ports of the machine; a test puts them in."""
    ports: list[ListPortInfo] = []
    monkeypatch.setattr(list_ports, "comports", lambda: list(ports))
    return ports


def test_an_adapter_is_known_by_what_it_says(present: list[ListPortInfo], tmp_path: Path) -> None:
    present.append(port("/dev/ttyACM0"))
    assert port_identity("/dev/ttyACM0") == BOARD
    link = tmp_path / "board"
    link.symlink_to("/dev/ttyACM0")
    assert port_identity(str(link)) == BOARD
    assert port_identity("/dev/ttyACM1") is None


@pytest.mark.parametrize("missing", [{"vid": None}, {"pid": None}, {"serial_number": None}, {"serial_number": ""}])
def test_what_does_not_say_all_of_it_has_no_identity(present: list[ListPortInfo], missing: dict[str, Any]) -> None:
    present.append(port("/dev/ttyACM0", **missing))
    assert port_identity("/dev/ttyACM0") is None


def test_it_is_found_under_its_new_name(present: list[ListPortInfo]) -> None:
    present += [
        port("/dev/ttyACM0", serial_number="0043"),
        port("/dev/ttyACM2", location="2-3:1.2"),  # the other port of the same board
        port("/dev/ttyACM1", location="2-3:1.0"),  # in another socket
    ]
    assert find_port(BOARD, GONE) == "/dev/ttyACM1"
    assert find_port(BOARD._replace(serial_number="0044"), GONE) is None
    present.append(port("/dev/ttyACM3"))  # says the same: no guess
    assert find_port(BOARD, GONE) is None


def test_a_configured_path_that_exists_or_is_of_udev_is_kept(present: list[ListPortInfo], tmp_path: Path) -> None:
    present.append(port("/dev/ttyACM1"))
    assert find_port(BOARD, "/dev/null") is None
    assert find_port(BOARD, "/dev/serial/by-id/usb-RD_board_0042-if00") is None
    dangling = tmp_path / "board"
    dangling.symlink_to("/dev/ttyACM0")
    assert find_port(BOARD, str(dangling)) is None


@pytest.mark.parametrize(
    "error", [OSError("gone"), TypeError("int() argument must not be None"), ValueError("base 16")]
)
def test_ports_that_vanish_while_listed_are_left_out(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def comports() -> list[ListPortInfo]:
        raise error

    monkeypatch.setattr(list_ports, "comports", comports)
    assert serial_ports() == []
    assert find_port(BOARD, GONE) is None


PATH = "/dev/ttyUSB7"


@pytest.fixture
def timer(tmp_path: Path) -> Path:
    """The latency timer of the adapter behind PATH, at 16 ms."""
    timer = tmp_path / "ttyUSB7" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    return timer


def test_a_timer_that_may_not_be_shortened_is_reported_once_with_the_rule(
    timer: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_path: Path, _text: str) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "write_text", refuse)
    caplog.set_level(logging.INFO)
    shorten_latency_timer(PATH, timer.parents[2])
    shorten_latency_timer(PATH, timer.parents[2])
    (record,) = caplog.records
    assert record.levelno == logging.INFO
    assert f"{PATH} delivers bytes only every 16 ms" in record.getMessage()
    assert 'ATTR{latency_timer}="1"' in record.getMessage()


@pytest.mark.parametrize(("text", "then"), [("16\n", "1"), ("1\n", "1\n"), ("0", "0"), ("none", "none")])
def test_a_timer_is_shortened_and_one_that_is_short_or_unreadable_left_alone(
    timer: Path, text: str, then: str, caplog: pytest.LogCaptureFixture
) -> None:
    timer.write_text(text)
    caplog.set_level(logging.INFO)
    shorten_latency_timer(PATH, timer.parents[2])
    assert timer.read_text() == then
    assert not caplog.records
