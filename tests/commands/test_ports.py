"""`resonatord ports` and `resonatord identify` as a user meets them, with emulated boards and made-up devices."""

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from emulation import emulated
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from resonator_daemon.board.links import usb_link as usb_devices
from resonator_daemon.board.links.carriers import serial as serial_carrier
from resonator_daemon.board.links.port_holders import Holders
from resonator_daemon.board.session import probe as port_inquiry
from resonator_daemon.commands import main
from simulators.emulator import EmulatorOptions


@pytest.fixture
def board(tmp_path: Path) -> Iterator[str]:
    """The link of an emulated board."""
    port = tmp_path / "board"
    with emulated(EmulatorOptions("quartz16", pty=port)):
        yield f"serial:{port}?baud=4000000"


@pytest.fixture
def present(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[ListPortInfo]:
    """The serial ports of a machine without USB boards; a test puts them in."""
    found: list[ListPortInfo] = []
    monkeypatch.setattr(list_ports, "comports", lambda: list(found))
    monkeypatch.setattr(usb_devices, "present_boards", lambda: [])
    monkeypatch.setattr(serial_carrier, "BY_ID", tmp_path / "by-id")
    return found


def serial_port(device: str, **attributes: Any) -> ListPortInfo:
    info = ListPortInfo(device)
    for name, value in attributes.items():
        setattr(info, name, value)
    return info


def asked(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any]]:
    code = main([*arguments, "--json"])
    printed = json.loads(capsys.readouterr().out)
    assert isinstance(printed, dict)
    return code, printed


def test_ports_are_listed_with_the_line_to_copy(
    present: list[ListPortInfo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(serial_carrier, "port_holders", lambda _path: Holders((), all_seen=False))
    (tmp_path / "by-id").mkdir()
    by_id = tmp_path / "by-id" / "usb-RD_board_0042-if00"
    by_id.symlink_to("/dev/null")
    present += [
        serial_port("/dev/null", vid=0x1209, pid=0xA, serial_number="0042", description="RD board"),
        serial_port("/dev/zero"),
    ]
    assert main(["ports"]) == 0
    printed, noted = capsys.readouterr()
    assert noted.startswith("programs that this user may not look at are not shown as holders; root ")
    board = "    looks like a board; to be sure: resonatord identify\n"
    assert f'/dev/null  1209:000a 0042 RD board\n{board}    link = "serial:{by_id}?baud=4000000"\n' in printed
    assert '/dev/zero  no description\n    link = "serial:/dev/zero?baud=4000000"\n' in printed
    code, listed = asked(capsys, "ports")
    assert code == 0
    first, second = listed["ports"]
    assert (first["link"], first["by_id"]) == (f"serial:{by_id}?baud=4000000", str(by_id))
    assert (first["usb_id"], first["serial_number"], first["permitted"]) == ("1209:000a", "0042", True)
    assert (second["usb_id"], second["serial_number"], second["description"]) == (None, None, None)
    assert (first["looks_like_a_board"], second["looks_like_a_board"]) == (True, False)


@pytest.mark.parametrize(
    ("printed", "expected"),
    [
        ({"vid": 0x1209, "pid": 0x0001}, True),
        ({"vid": 0x1209, "pid": 0x0002}, False),
        ({"vid": 0x0403, "pid": 0x6001, "description": "FT232R USB UART"}, False),
        ({"vid": 0x0403, "pid": 0x6001, "product": "Resonator counter"}, True),
    ],
)
def test_what_looks_like_a_board_is_reported_without_opening_it(
    present: list[ListPortInfo], capsys: pytest.CaptureFixture[str], printed: dict[str, Any], expected: bool
) -> None:
    present.append(serial_port("/dev/null", **printed))
    assert asked(capsys, "ports")[1]["ports"][0]["looks_like_a_board"] is expected


def test_for_programs_it_is_one_object(board: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, printed = asked(capsys, "identify", board)
    assert (code, printed["ok"], printed["description"]["plate"]) == (0, True, "quartz16")
    assert printed["identity"]["serial_number"] == "EMU-0001"
    assert printed["round_trip_s"]["answers"] > 10
    assert 0 < printed["round_trip_s"]["shortest"] <= printed["round_trip_s"]["median"]
    assert printed["tick_rate"]["plausible"] is True
    assert printed["misfits"] == []


@pytest.mark.parametrize(("plate", "code"), [("quartz16", 0), ("comb16", 69)])
def test_a_configuration_names_the_link_and_is_compared(
    board: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], plate: str, code: int
) -> None:
    config = tmp_path / "board.toml"
    config.write_text(f'plate = "{plate}"\nlink = "{board}"\n')
    found, answer = asked(capsys, "identify", "--config", str(config))
    assert (found, "wrong_plate" in answer["misfit_codes"]) == (code, code == 69)
    assert main(["identify", "--config", str(config)]) == code
    printed = capsys.readouterr()
    assert "EMU-0001" in printed.out
    assert ("the board describes quartz16, the plate file has comb16" in printed.err) is (code == 69)


def test_who_does_not_answer_is_no_board(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(port_inquiry, "ANSWER_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        code, printed = asked(capsys, "identify", f"tcp://127.0.0.1:{silent.getsockname()[1]}")
    assert (code, printed["ok"], printed["error"]["code"]) == (69, False, "no_board")
