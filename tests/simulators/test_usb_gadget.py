"""The emulated USB device as any program sees it: through pyusb's own interface, without the daemon's link."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from usb_bench import SERIAL_NUMBER, HostError, UsbBoardEnd, UsbHost, usb_board, usb_host

from resonator_daemon.errors import UserError
from simulators import usb_link
from simulators.usb_link import UsbLink

_IMPORTS = """
import errno
import usb.core

def find():
    return usb.core.find(idVendor=0x1209, idProduct=0x0001)

def number_of_error(action, *arguments):
    try:
        action(*arguments)
    except usb.core.USBError as error:
        return errno.errorcode[error.errno]
"""
_BEGIN = "device.ctrl_transfer(0x41, 0x01, 1, 0)"


@pytest.fixture
def board() -> Iterator[UsbBoardEnd]:
    with usb_board() as board:
        yield board


@pytest.fixture
def host(board: UsbBoardEnd) -> Iterator[UsbHost]:
    with usb_host(board) as host:
        host.run(_IMPORTS)
        host.run("device = find()")
        yield host


def test_it_is_described_as_the_protocol_says(host: UsbHost) -> None:
    strings = "[device.manufacturer, device.product, device.serial_number]"
    assert host.value(strings) == ["resonatord", "emulated counter board", SERIAL_NUMBER]
    host.run("interface = device.get_active_configuration()[(0, 0)]")
    kinds = "interface.bInterfaceClass, interface.bInterfaceSubClass, interface.bInterfaceProtocol"
    assert host.value(f"({kinds})") == (0xFF, 0x52, 0x01)
    ends = "[(end.bEndpointAddress, end.bmAttributes, end.wMaxPacketSize) for end in interface]"
    assert host.value(ends) == [(0x01, 2, 512), (0x81, 2, 512)]


def test_bytes_go_both_ways(board: UsbBoardEnd, host: UsbHost) -> None:
    host.run("device.set_configuration()")
    assert host.value("device.write(0x01, b'to the board')") == 12
    board.wait(lambda: board.received == b"to the board")
    board.send(bytes(range(200)))
    host.run("data = b''")
    host.run("while len(data) < 200: data += bytes(device.read(0x81, 64, 20000))")
    assert host.value("data") == bytes(range(200))


def test_a_beginning_throws_away_what_is_under_way(board: UsbBoardEnd, host: UsbHost) -> None:
    board.send(bytes(1_000_000))  # more than all buffers between hold
    host.run("device.set_configuration()")
    assert host.value("bytes(device.read(0x81, 512, 20000))") == bytes(512)
    host.run(_BEGIN)
    assert board.begins == 1
    board.send(b"fresh")
    assert host.value("bytes(device.read(0x81, 512, 20000))") == b"fresh"


def test_other_control_requests_are_refused(board: UsbBoardEnd, host: UsbHost) -> None:
    for request in ("0x41, 0x01, 2, 0", "0x41, 0x02, 1, 0", "0xC1, 0x01, 1, 0, 8"):
        assert host.value(f"number_of_error(device.ctrl_transfer, {request})") == "EPIPE"
    assert board.begins == 0


def test_nothing_to_read_is_a_timeout(host: UsbHost) -> None:
    host.run("device.set_configuration()")
    assert host.value("number_of_error(device.read, 0x81, 512, 20)") == "ETIMEDOUT"


def test_a_stalled_endpoint_stays_so_until_it_is_cleared(board: UsbBoardEnd, host: UsbHost) -> None:
    host.run("device.set_configuration()")
    board.link.stall()
    board.send(b"behind")
    for _ in range(2):
        assert host.value("number_of_error(device.read, 0x81, 512, 20000)") == "EPIPE"
    host.run("device.clear_halt(0x81)")
    assert host.value("bytes(device.read(0x81, 512, 20000))") == b"behind"


def test_an_unplugged_device_is_gone_and_comes_back_with_another_address(board: UsbBoardEnd, host: UsbHost) -> None:
    host.run("device.set_configuration()")
    address = host.value("device.address")
    board.link.hang_up()
    board.link.hang_up()
    assert (board.link.write_fd, board.link.write(b"x")) == (None, 0)
    host.run("error = None")
    host.run("while error != 'ENODEV': error = number_of_error(device.write, 0x01, b'x')")
    host.run("while find() is not None: pass")
    board.link.plug_in()
    board.link.plug_in()
    host.run("while find() is None: pass")
    host.run("device = find()")
    assert host.value("device.address") != address
    assert host.value("device.serial_number") == SERIAL_NUMBER
    board.send(b"back")
    assert host.value("bytes(device.read(0x81, 512, 20000))") == b"back"


def test_one_host_claims_it_and_frees_it_when_it_ends(board: UsbBoardEnd, host: UsbHost) -> None:
    with usb_host(board) as first:
        first.run(_IMPORTS)
        first.run("device = find(); device.set_configuration()")
        first.run("usb.util.claim_interface(device, 0)")
        with pytest.raises(HostError, match=r"USBError.*busy"):
            host.run("usb.util.claim_interface(device, 0)")
    host.run("usb.util.claim_interface(device, 0)")


def test_nothing_is_left_of_it(tmp_path: Path) -> None:
    link = UsbLink(SERIAL_NUMBER, lambda: None)
    root = Path(link.environment["UMOCKDEV_DIR"])
    assert (root / "dev/bus/usb").is_dir()
    link.close()
    link.close()
    assert not root.exists()
    assert link._process.returncode == 0


def test_what_is_missing_is_said_with_the_packages_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    packages = r"apt-get install umockdev gir1\.2-umockdev-1\.0 python3-gi libusb-1\.0-0$"
    descriptors = os.listdir("/proc/self/fd")
    monkeypatch.setattr(usb_link, "_PYTHON", "/usr/bin/no-python")
    with pytest.raises(UserError, match=r"^/usr/bin/no-python cannot be started \(No such file.*\); " + packages):
        UsbLink(SERIAL_NUMBER, lambda: None)
    monkeypatch.setattr(usb_link, "_PYTHON", sys.executable)  # an environment without gi
    with pytest.raises(UserError, match=r"No module named 'gi'; " + packages):
        UsbLink(SERIAL_NUMBER, lambda: None)
    assert os.listdir("/proc/self/fd") == descriptors
