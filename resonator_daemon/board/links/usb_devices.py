"""Finding boards among USB devices, by the vendor class of their interface.

pyusb's backend is used as it is, below its `Device`: a link must detect when its handle is closed, and its asynchronous
transfers need that handle.
"""

from array import array
from dataclasses import dataclass
from typing import Any

import usb.backend.libusb1
import usb.core

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.links.carriers.usb import UsbTarget
from resonator_daemon.board.links.link import LinkUnavailableError

INTERFACE = (0xFF, 0x52, 0x01)  # class, subclass, protocol; PROTOCOL.md, section USB

FAILURES = (usb.core.USBError, NotImplementedError)  # the latter is what pyusb makes of LIBUSB_ERROR_NOT_SUPPORTED

_GET_DESCRIPTOR = (0x80, 0x06)  # bmRequestType, bRequest
_STRING, _ENGLISH = 0x0300, 0x0409
_STRING_BYTES_MAX = 255
_CONTROL_TIMEOUT_MS = 500


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
    boards = []
    for device in devices:
        try:
            boards += _boards_of(backend, device)
        except FAILURES:
            continue  # it went away meanwhile, or shows no descriptors: no board
    return sorted(boards, key=lambda board: (board.bus, board.address))


def _boards_of(backend: Any, device: Any) -> list[UsbBoard]:
    """Return the board that a device is, if it is one."""
    descriptor = backend.get_device_descriptor(device)
    for index in range(descriptor.bNumConfigurations):
        configuration = backend.get_configuration_descriptor(device, index)
        for number in range(configuration.bNumInterfaces):
            interface = backend.get_interface_descriptor(device, number, 0, index)
            if (interface.bInterfaceClass, interface.bInterfaceSubClass, interface.bInterfaceProtocol) == INTERFACE:
                return [
                    UsbBoard(
                        descriptor.idVendor,
                        descriptor.idProduct,
                        _string(backend, device, descriptor.iSerialNumber),
                        descriptor.bus,
                        descriptor.address,
                        interface.bInterfaceNumber,
                        configuration.bConfigurationValue,
                        device,
                    )
                ]
    return []


def _string(backend: Any, device: Any, index: int) -> str | None:
    """Return a device's string; None where it has none or this user may not ask for it."""
    if index == 0:
        return None
    try:
        handle = backend.open_device(device)
    except FAILURES:
        return None
    buffer = array("B", bytes(_STRING_BYTES_MAX))
    try:
        size = backend.ctrl_transfer(handle, *_GET_DESCRIPTOR, _STRING | index, _ENGLISH, buffer, _CONTROL_TIMEOUT_MS)
    except FAILURES:
        return None
    finally:
        backend.close_device(handle)
    return buffer[2 : min(size, buffer[0])].tobytes().decode("utf-16-le", errors="replace") or None
