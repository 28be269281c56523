"""The same adapter under another name, told by what it says of itself."""

from pathlib import Path
from typing import Any

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from resonator_daemon.board.links.port_identity import PortIdentity, find_port, port_identity, serial_ports

BOARD = PortIdentity(0x1209, 0x0002, "0042", "1.0")


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
    assert find_port(BOARD) == "/dev/ttyACM1"
    assert find_port(BOARD, "/dev/ttyACM9") == "/dev/ttyACM1"
    assert find_port(BOARD._replace(serial_number="0044")) is None


def test_two_that_say_the_same_are_not_guessed_between(present: list[ListPortInfo]) -> None:
    present += [port("/dev/ttyACM1"), port("/dev/ttyACM2", location="2-1:1.0")]
    assert find_port(BOARD) is None


def test_a_configured_path_that_is_there_or_belongs_to_udev_is_left_to_itself(
    present: list[ListPortInfo], tmp_path: Path
) -> None:
    present.append(port("/dev/ttyACM1"))
    assert find_port(BOARD, "/dev/null") is None
    assert find_port(BOARD, "/dev/serial/by-id/usb-RD_board_0042-if00") is None
    dangling = tmp_path / "board"
    dangling.symlink_to("/dev/ttyACM0")
    assert find_port(BOARD, str(dangling)) is None


@pytest.mark.parametrize(
    "error", [OSError("gone"), TypeError("int() argument must not be None"), ValueError("base 16")]
)
def test_ports_that_vanish_while_they_are_listed_are_no_crash(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def comports() -> list[ListPortInfo]:
        raise error

    monkeypatch.setattr(list_ports, "comports", comports)
    assert serial_ports() == []
    assert find_port(BOARD) is None
