"""Identity of the adapter behind a serial port, which finds it again under another name."""

import os
from typing import NamedTuple

from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo


class PortIdentity(NamedTuple):
    """Identity of a USB adapter; `interface` distinguishes the ports of one adapter, "" where it has one."""

    vendor_id: int
    product_id: int
    serial_number: str
    interface: str


def port_identity(path: str) -> PortIdentity | None:
    """Return who is behind a port; None for what is not USB, is not there or has no serial number of its own."""
    device = os.path.realpath(path)
    return next((identity for port, identity in _identified() if port == device), None)


def find_port(identity: PortIdentity, configured: str | None = None) -> str | None:
    """Return the device that is this adapter now, as /dev/ttyACM1; None where it is not present.

    Parameters
    ----------
    identity
        From `port_identity`, while the port was there.
    configured
        The path that the configuration names. While there is something at it, or where it is a link that udev or an
        emulator keeps, the answer is None: what was named is what is meant.
    """
    if configured is not None and (os.path.lexists(configured) or not _names_a_device(configured)):
        return None
    found = [port for port, candidate in _identified() if candidate == identity]
    return found[0] if len(found) == 1 else None


def serial_ports() -> list[ListPortInfo]:
    """Return the serial ports present, those that vanish while they are looked at left out."""
    try:
        return sorted(list_ports.comports())
    except (OSError, TypeError, ValueError):  # pyserial's, of what sysfs no longer has
        return []


def _identified() -> list[tuple[str, PortIdentity]]:
    return [
        (port.device, PortIdentity(port.vid, port.pid, port.serial_number, _interface(port)))
        for port in serial_ports()
        if port.vid is not None and port.pid is not None and port.serial_number
    ]


def _interface(port: ListPortInfo) -> str:
    return (port.location or "").partition(":")[2]


def _names_a_device(path: str) -> bool:
    return os.path.dirname(os.path.abspath(path)) == "/dev"
