"""The USB link: finding and claiming a board, and a stream of bytes over its two bulk endpoints.

An open board uses pyusb's backend as it is, below its `Device`: a link must detect when its handle is closed, and its
asynchronous transfers need that handle.
"""

import errno
import os
import time
from array import array
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any

import usb.backend.libusb1
import usb.core
import usb.util
from usb.core import USBError, USBTimeoutError

from firmware_protocol.layouts import PROTOCOL_MAJOR
from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.links.carriers.usb import UsbTarget
from resonator_daemon.board.links.link import (
    CLOSED_HERE,
    WRITE_TIMEOUT_S,
    LinkLostError,
    LinkUnavailableError,
    write_timeout,
)
from resonator_daemon.board.links.port_holders import port_holders
from resonator_daemon.board.links.usb_transfers import BulkReader, Failure

INTERFACE = (0xFF, 0x52, 0x01)  # class, subclass, protocol; PROTOCOL.md, section USB

FAILURES = (usb.core.USBError, NotImplementedError)  # the latter is what pyusb makes of LIBUSB_ERROR_NOT_SUPPORTED

_ENGLISH = 0x0409


@dataclass(frozen=True)
class UsbBoard:
    """A board on a USB bus.

    Attributes
    ----------
    serial_number
        None where this user may not open the device, or it has none.
    interface
        Number of the interface to claim.
    configuration
        Value of the configuration that has the interface.
    device
        The backend's handle on the device, for opening it.
    """

    vendor_id: int
    product_id: int
    serial_number: str | None
    bus: int
    address: int
    interface: int
    configuration: int
    device: Any  # pyusb has no types

    @property
    def node(self) -> str:
        return f"/dev/bus/usb/{self.bus:03d}/{self.address:03d}"

    @property
    def link(self) -> str:
        """What a configuration calls it."""
        return str(UsbTarget(self.vendor_id, self.product_id, self.serial_number or None))


def usb_backend() -> Any:
    """Return pyusb's backend over libusb 1.0.

    Raises
    ------
    LinkUnavailableError
        The library is not installed, or cannot be used here.
    """
    backend = usb.backend.libusb1.get_backend()
    if backend is None:
        raise LinkUnavailableError(
            ReasonCode.PORT_UNUSABLE, "libusb 1.0 cannot be loaded; install it: apt-get install libusb-1.0-0"
        )
    return backend


def present_boards() -> list[UsbBoard]:
    """Return all boards on all buses, in the order of their addresses.

    Raises
    ------
    LinkUnavailableError
        The USB library is missing, or cannot list what is there.
    """
    backend = usb_backend()
    try:
        devices = list(backend.enumerate_devices())
    except FAILURES as error:
        raise LinkUnavailableError(
            ReasonCode.PORT_UNUSABLE, f"USB devices cannot be listed: {meaning_of(error)}"
        ) from error
    boards: list[UsbBoard] = []
    for found in devices:
        with suppress(*FAILURES):  # it went away meanwhile, or shows no descriptors: no board
            boards += islice(_boards_of(usb.core.Device(found, backend), found), 1)
    return sorted(boards, key=lambda board: (board.bus, board.address))


def _boards_of(device: Any, found: Any) -> Iterator[UsbBoard]:
    """Yield the board that a device is, for each interface that makes it one."""
    for configuration in device:
        for interface in configuration:
            if (interface.bInterfaceClass, interface.bInterfaceSubClass, interface.bInterfaceProtocol) == INTERFACE:
                yield UsbBoard(
                    device.idVendor,
                    device.idProduct,
                    _serial_number(device),
                    device.bus,
                    device.address,
                    interface.bInterfaceNumber,
                    configuration.bConfigurationValue,
                    found,
                )


def _serial_number(device: Any) -> str | None:
    """Return a device's serial number; None where it has none or this user may not ask for it."""
    if not device.iSerialNumber:
        return None
    try:
        return usb.util.get_string(device, device.iSerialNumber, _ENGLISH) or None
    except (*FAILURES, ValueError):  # ValueError: no UTF-16
        return None
    finally:
        usb.util.dispose_resources(device)


_ENDPOINT_OUT, _ENDPOINT_IN = 0x01, 0x81
_BEGIN = (0x41, 0x01)  # bmRequestType, bRequest; vendor, to the interface
_BEGIN_TIMEOUT_MS = 1000
_END_TRANSFERS_S = 0.5
_HALTS_IN_A_ROW = 3  # after which the device is taken for one that cannot recover
_WHAT_FAILED = {
    Failure.ERROR: "transfer errors",
    Failure.TIMED_OUT: "timeouts",
    Failure.STALL: "stalls",
    Failure.OVERFLOW: "packets larger than they may be",
}


def open_usb(target: UsbTarget) -> "UsbBulkLink":
    """Find the board, claim it for this process alone and have it begin again.

    Raises
    ------
    LinkUnavailableError
        No such board, more than one, no permission, claimed by another program, or no libusb.
    """
    board = _find(target)
    backend = usb_backend()
    try:
        handle = backend.open_device(board.device)
    except FAILURES as error:
        raise LinkUnavailableError(*_why_not(board, error)) from error
    try:
        # Setting the configuration again would be a light reset, and fails while other interfaces are in use.
        if backend.get_configuration(handle) != board.configuration:
            backend.set_configuration(handle, board.configuration)
        backend.claim_interface(handle, board.interface)
        _begin(backend, handle, board)
    except FAILURES as error:
        backend.close_device(handle)  # which releases what was claimed
        raise LinkUnavailableError(*_why_not(board, error)) from error
    except LinkUnavailableError:
        backend.close_device(handle)
        raise
    return UsbBulkLink(backend, handle, board)


class UsbBulkLink:
    """An open board. Where transfers stop for any reason but the board's going, they are taken up again."""

    def __init__(self, backend: Any, handle: Any, board: UsbBoard) -> None:
        self._backend = backend
        self._handle = handle
        self._board = board
        self._lost: Reason | None = None
        self._halts_in_a_row = 0
        self._reader = BulkReader(backend, handle, _ENDPOINT_IN)
        self._reader.start()

    @property
    def overruns(self) -> int:
        """Always 0: a device waits until the host asks."""
        return 0

    def read(self, timeout_s: float) -> bytes:
        self._check()
        deadline = time.monotonic() + timeout_s
        while True:
            if data := self._reader.pop_received():
                self._halts_in_a_row = 0
                return data
            if self._reader.failure is not None:
                self._recover(self._reader.failure)
            left_s = deadline - time.monotonic()
            if left_s <= 0.0 and timeout_s > 0.0:
                return b""
            self._reader.wait(left_s)
            if timeout_s <= 0.0:
                return self._reader.pop_received()

    def write(self, data: bytes) -> None:
        self._check()
        deadline = time.monotonic() + WRITE_TIMEOUT_S
        while data:
            left_ms = int((deadline - time.monotonic()) * 1e3)
            if left_ms <= 0:  # libusb would take 0 for ever
                raise write_timeout()
            try:
                written = self._backend.bulk_write(
                    self._handle, _ENDPOINT_OUT, self._board.interface, array("B", data), left_ms
                )
                data = data[int(written) :]
            except USBTimeoutError:
                continue
            except FAILURES as error:
                if _number(error) != errno.EPIPE:
                    raise self._lose(*_unplugged(error)) from error
                self._clear_halt(_ENDPOINT_OUT)

    def close(self) -> None:
        if self._handle is None:
            return
        handle, self._handle = self._handle, None
        self._lost = self._lost or CLOSED_HERE
        if self._reader.close(_END_TRANSFERS_S):
            with suppress(*FAILURES):
                self._backend.release_interface(handle, self._board.interface)
            self._backend.close_device(handle)

    def _recover(self, failure: Failure) -> None:
        """End what is in flight, clear the endpoint's halt and go on."""
        if failure is Failure.NO_DEVICE:
            raise self._lose(ReasonCode.UNPLUGGED, "unplugged (no such device)")
        if not self._reader.stop(_END_TRANSFERS_S):
            raise self._lose(ReasonCode.TRANSFERS_FAIL, "the USB driver does not give transfers back")
        self._clear_halt(_ENDPOINT_IN)
        if self._halts_in_a_row > _HALTS_IN_A_ROW:
            raise self._lose(
                ReasonCode.TRANSFERS_FAIL, f"the board answers with {_WHAT_FAILED[failure]} again and again"
            )
        self._reader.start()

    def _clear_halt(self, endpoint: int) -> None:
        self._halts_in_a_row += 1
        try:
            self._backend.clear_halt(self._handle, endpoint)
        except FAILURES as error:
            raise self._lose(*_unplugged(error)) from error

    def _lose(self, code: ReasonCode, text: str) -> LinkLostError:
        self._lost = Reason(code, text)
        return LinkLostError(code, text)

    def _check(self) -> None:
        if self._lost is not None:
            raise LinkLostError(*self._lost)


def _find(target: UsbTarget) -> UsbBoard:
    boards = present_boards()
    alike = [board for board in boards if (board.vendor_id, board.product_id) == (target.vendor_id, target.product_id)]
    found = [board for board in alike if target.serial_number in (None, board.serial_number)]
    if len(found) == 1:
        return found[0]
    if found:
        raise LinkUnavailableError(
            ReasonCode.PORT_UNUSABLE, f"{len(found)} boards are {target}; name one of them: {_links(found)}"
        )
    for board in alike:
        if board.serial_number is None and not os.access(board.node, os.R_OK | os.W_OK):
            raise LinkUnavailableError(*_not_permitted(board))
    present = f"present: {_links(boards)}" if boards else "no board is on any USB bus"
    raise LinkUnavailableError(ReasonCode.NO_SUCH_PORT, f"no board is {target}; {present}")


def _links(boards: list[UsbBoard]) -> str:
    return ", ".join(board.link for board in boards)


def _begin(backend: Any, handle: Any, board: UsbBoard) -> None:
    try:
        backend.ctrl_transfer(handle, *_BEGIN, PROTOCOL_MAJOR, board.interface, array("B"), _BEGIN_TIMEOUT_MS)
    except USBTimeoutError as error:
        reason = f"{board.link} does not begin again within {_BEGIN_TIMEOUT_MS} ms; plug it in again"
        raise LinkUnavailableError(ReasonCode.NO_BOARD_ANSWERS, reason) from error
    except USBError as error:
        if error.errno != errno.EPIPE:
            raise
        reason = f"{board.link} refuses to begin with protocol {PROTOCOL_MAJOR}; its firmware may use another one"
        raise LinkUnavailableError(ReasonCode.WRONG_PROTOCOL, reason) from error


def _why_not(board: UsbBoard, error: Exception) -> Reason:
    match _number(error):
        case errno.EACCES | errno.EPERM:
            return _not_permitted(board)
        case errno.EBUSY:
            others = [str(it) for it in port_holders(board.node).processes if it.pid != os.getpid()]
            holders = " and ".join(others) or "another program"
            return Reason(ReasonCode.PORT_IN_USE, f"{board.link} is held by {holders}; close it there")
        case errno.ENODEV | errno.ENOENT:
            return Reason(ReasonCode.NO_SUCH_PORT, f"{board.link} went away while it was opened")
        case _:
            return Reason(ReasonCode.PORT_UNUSABLE, f"{board.link} cannot be opened: {meaning_of(error)}")


def _not_permitted(board: UsbBoard) -> Reason:
    return Reason(
        ReasonCode.PERMISSION_DENIED,
        f"{board.node} ({board.vendor_id:04x}:{board.product_id:04x}) may not be opened by this user; put "
        f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{board.vendor_id:04x}", ATTR{{idProduct}}=="{board.product_id:04x}", '
        'GROUP="resonatord", MODE="0660" into /etc/udev/rules.d/70-resonatord.rules (as root, `resonatord install` '
        "does for boards of its ids), join the group resonatord and plug it in again",
    )


def _number(error: Exception) -> int | None:
    return getattr(error, "errno", None)


def _unplugged(error: Exception) -> Reason:
    return Reason(ReasonCode.UNPLUGGED, f"unplugged ({meaning_of(error)})")
