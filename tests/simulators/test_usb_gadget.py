"""The emulated USB device as any program sees it: through pyusb's own interface, without the daemon's link."""

import os
import sys
from collections.abc import Iterator

import pytest
from usb_bench import SERIAL_NUMBER, UsbBoardEnd, UsbHost, usb_board, usb_host

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


def test_other_control_requests_are_refused(board: UsbBoardEnd, host: UsbHost) -> None:
    for request in ("0x41, 0x01, 2, 0", "0x41, 0x02, 1, 0", "0xC1, 0x01, 1, 0, 8"):
        assert host.value(f"number_of_error(device.ctrl_transfer, {request})") == "EPIPE"
    assert board.begins == 0


def test_what_is_missing_is_said_with_the_packages_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    packages = r"apt-get install umockdev gir1\.2-umockdev-1\.0 python3-gi libusb-1\.0-0$"
    descriptors = os.listdir("/proc/self/fd")
    monkeypatch.setattr(usb_link, "SYSTEM_PYTHON", "/usr/bin/no-python")
    with pytest.raises(UserError, match=r"^/usr/bin/no-python cannot be started \(No such file.*\); " + packages):
        UsbLink(SERIAL_NUMBER, lambda: None)
    monkeypatch.setattr(usb_link, "SYSTEM_PYTHON", sys.executable)  # an environment without gi
    with pytest.raises(UserError, match=r"No module named 'gi'; " + packages):
        UsbLink(SERIAL_NUMBER, lambda: None)
    assert os.listdir("/proc/self/fd") == descriptors
