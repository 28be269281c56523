"""The USB link over real libusb and unmodified pyusb; what no emulated device can do is made at pyusb's edge."""

import os
from collections.abc import Iterator
from contextlib import closing

import pytest
from link_bench import LINK, SERIAL_NUMBER, BoardEnd, HostError, UsbHost, usb_host

from resonator_daemon.board.links import usb_link
from resonator_daemon.board.links.carriers.usb import UsbTarget
from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.links.usb_link import UsbBoard, open_usb
from simulators.usb_link import UsbLink

UNSUPPORTED = "Operation not supported or unimplemented on this platform"

_IMPORTS = """
import errno, hashlib, os, threading
from usb.core import USBError
from resonator_daemon.board.links import usb_link
from resonator_daemon.board.links import usb_transfers
from resonator_daemon.board.links.port_holders import Holder, Holders
from resonator_daemon.board.links.usb_link import present_boards
from resonator_daemon.board.links.usb_link import open_usb
from resonator_daemon.board.links.carriers import parse_link

def open_link(text):
    global link
    link = open_usb(parse_link(text))

def take(size):
    data = b""
    while len(data) < size:
        piece = link.read(20.0)
        if not piece:
            raise TimeoutError(f"{len(data)} of {size} bytes came")
        data += piece
    return data

def digest(data):
    return hashlib.sha256(data).hexdigest()

def links():
    return [board.link for board in present_boards()]

def unsupported(*arguments):
    raise NotImplementedError("Operation not supported or unimplemented on this platform")

def held():
    return len(os.listdir("/proc/self/fd")), threading.active_count(), len(os.listdir("/proc/self/task"))
"""


@pytest.fixture
def board() -> Iterator[BoardEnd[UsbLink]]:
    with closing(BoardEnd(lambda begin: UsbLink(SERIAL_NUMBER, begin))) as board:
        yield board


@pytest.fixture
def host(board: BoardEnd[UsbLink]) -> Iterator[UsbHost]:
    with usb_host(board.link) as host:
        host.run(_IMPORTS)
        yield host


def refusal(host: UsbHost, link: str) -> str:
    return loss(host, f"open_link({link!r})", "LinkUnavailableError")


def loss(host: UsbHost, source: str, kind: str = "LinkLostError") -> str:
    with pytest.raises(HostError) as caught:
        host.run(source)
    found, _, text = str(caught.value).partition(": ")
    assert found == kind
    return text


def sha256(host: UsbHost, data: bytes) -> object:
    return host.value(f"digest(bytes.fromhex({data.hex()!r}))")


def test_a_stall_is_cleared(board: BoardEnd[UsbLink], host: UsbHost) -> None:
    host.run(f"open_link({LINK!r})")
    host.run("""
calls, clear = [], usb_link.usb_backend().clear_halt
usb_link.usb_backend().clear_halt = lambda handle, endpoint: (calls.append(endpoint), clear(handle, endpoint))
""")
    for times in (1, 2, 3, 4, 5):  # more than may follow each other
        board.link.stall()
        assert host.value("link.read(0.1)") == b""
        data = os.urandom(50_000)
        board.send(data)
        assert host.value(f"digest(take({len(data)}))") == sha256(host, data)
        assert host.value("calls") == [0x81] * times


@pytest.mark.parametrize("status", ["usb_transfers._CANCELLED", "usb_transfers.Failure.STALL"])
def test_what_came_before_a_transfer_ended_is_kept(host: UsbHost, status: str) -> None:
    host.run(f"open_link({LINK!r})")
    # The emulated device ends its transfers whole or empty; a real one may end them after some packets.
    host.run(f"""
reader = link._reader
assert reader.stop(20.0)
transfer, reader._buffers[0][:4] = reader._transfers[0].contents, b"part"
transfer.status, transfer.actual_length, reader._in_flight = int({status}), 4, 1
reader._ended(reader._transfers[0])
""")
    assert host.value("reader.pop_received(), reader._in_flight") == (b"part", 0)


def test_a_device_without_a_configuration_is_given_one(board: BoardEnd[UsbLink], host: UsbHost) -> None:
    host.run("""
backend, configurations = usb_link.usb_backend(), []
backend.get_configuration = lambda handle: 0
backend.set_configuration = lambda handle, value: configurations.append(value)
""")
    host.run(f"open_link({LINK!r})")
    host.run("link.close(); del backend.get_configuration")
    host.run(f"open_link({LINK!r})")  # it has one now: setting it anew would disturb its other interfaces
    assert host.value("configurations") == [1]


def test_a_board_that_stalls_without_end_is_given_up(board: BoardEnd[UsbLink], host: UsbHost) -> None:
    host.run(f"open_link({LINK!r})")
    for _ in range(10):
        board.link.stall()
    assert loss(host, "link.read(20.0)") == "the board answers with stalls again and again"
    assert loss(host, "link.write(b'x')") == "the board answers with stalls again and again"


def test_a_board_that_takes_no_bytes(board: BoardEnd[UsbLink], host: UsbHost) -> None:
    host.run(f"open_link({LINK!r})")
    board.answers.clear()
    assert loss(host, "while True: link.write(bytes(60000))") == "the board accepted no bytes for 1 s"


def test_a_board_that_does_not_begin(board: BoardEnd[UsbLink], host: UsbHost) -> None:
    board.answers.clear()
    assert refusal(host, LINK) == f"{LINK} does not begin again within 1000 ms; plug it in again"
    board.answers.set()
    host.run(f"open_link({LINK!r})")


def test_only_one_host_holds_a_board(board: BoardEnd[UsbLink], host: UsbHost) -> None:
    host.run(f"open_link({LINK!r})")
    with usb_host(board.link) as other:
        other.run(_IMPORTS)
        assert refusal(other, LINK) == f"{LINK} is held by another program; close it there"
        board.send(b"still there")
        assert host.value("take(11)") == b"still there"
        host.run("link.close()")
        other.run(f"open_link({LINK!r})")


def test_closing_waits_for_no_driver_that_hangs(board: BoardEnd[UsbLink], host: UsbHost) -> None:
    host.run(f"open_link({LINK!r})")
    board.link.hold_cancelled()
    assert host.value("link.read(0.1)") == b""
    host.run("link.close()")
    assert host.value("len(usb_transfers._left_behind)") == 1
    assert loss(host, "link.read(1.0)") == "closed here"


def a_board(serial_number: str | None, node_number: int) -> UsbBoard:
    return UsbBoard(0x1209, 0x0001, serial_number, 999, node_number, 0, 1, None)


def test_a_board_among_several_must_be_named(monkeypatch: pytest.MonkeyPatch) -> None:
    boards = [a_board("0042", 2), a_board("0043", 3), a_board("0042", 4)]
    monkeypatch.setattr(usb_link, "present_boards", lambda: boards)
    with pytest.raises(LinkUnavailableError) as caught:
        open_usb(UsbTarget(0x1209, 0x0001))
    links = "usb:1209:0001?serial=0042, usb:1209:0001?serial=0043, usb:1209:0001?serial=0042"
    assert str(caught.value) == f"3 boards are usb:1209:0001; name one of them: {links}"
    with pytest.raises(LinkUnavailableError, match=r"^2 boards are usb:1209:0001\?serial=0042; "):
        open_usb(UsbTarget(0x1209, 0x0001, "0042"))


@pytest.mark.parametrize(
    ("call", "source", "reason"),
    [
        ("bulk_write", "link.write(b'x')", f"unplugged ({UNSUPPORTED})"),
        ("clear_halt", "link.read(20.0)", f"unplugged ({UNSUPPORTED})"),
    ],
)
def test_what_a_system_does_not_support_ends_a_link(
    board: BoardEnd[UsbLink], host: UsbHost, call: str, source: str, reason: str
) -> None:
    host.run(f"open_link('{LINK}'); usb_link.usb_backend().{call} = unsupported")
    board.link.stall()
    assert loss(host, source) == reason
    host.run("usb_link.usb_backend().release_interface = unsupported; link.close()")


def test_a_device_that_shows_no_descriptors_hides_no_board(monkeypatch: pytest.MonkeyPatch) -> None:
    class Backend:
        def enumerate_devices(self) -> Iterator[object]:
            return iter(["strange"])

        def get_device_descriptor(self, device: object) -> object:
            raise NotImplementedError(UNSUPPORTED)

    monkeypatch.setattr(usb_link, "usb_backend", Backend)
    assert usb_link.present_boards() == []
