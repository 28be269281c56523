"""Places where a board may be connected: serial ports and USB boards, each with the link that names it."""

import os
from dataclasses import dataclass
from pathlib import Path

from serial.tools.list_ports_common import ListPortInfo

from resonator_daemon.links.port_holders import Holder, port_holders
from resonator_daemon.links.port_identity import serial_ports

BY_ID = Path("/dev/serial/by-id")  # links to serial ports, with names that stay
_BAUD = 4_000_000
_OWN_IDS = frozenset({(0x1209, 0x0001)})  # those that the installed udev rules name
_OWN_WORDS = ("resonat", "rd board")  # in the strings of a USB device


@dataclass(frozen=True, slots=True)
class Place:
    """A serial port, or a board's own USB interface; what is not known is None."""

    link: str
    kind: str
    device: str
    by_id: str | None
    usb_id: str | None
    serial_number: str | None
    description: str | None
    held_by: tuple[Holder, ...]
    held_by_all_seen: bool
    permitted: bool
    looks_like_a_board: bool  # by ids and strings alone: nothing is opened


def serial_places() -> list[Place]:
    """Return the serial ports."""
    by_id = _by_id()
    places = []
    for port in serial_ports():
        path = by_id.get(os.path.realpath(port.device))
        holders = port_holders(port.device)
        places.append(
            Place(
                link=f"serial:{path or port.device}?baud={_BAUD}",
                kind="serial",
                device=port.device,
                by_id=path,
                usb_id=None if port.vid is None or port.pid is None else f"{port.vid:04x}:{port.pid:04x}",
                serial_number=port.serial_number or None,
                description=None if port.description in (None, "n/a") else port.description,
                held_by=holders.processes,
                held_by_all_seen=holders.all_seen,
                permitted=os.access(port.device, os.R_OK | os.W_OK),
                looks_like_a_board=_looks_like_a_board(port),
            )
        )
    return places


def _looks_like_a_board(port: ListPortInfo) -> bool:
    strings = " ".join(filter(None, (port.manufacturer, port.product, port.description))).lower()
    return (port.vid, port.pid) in _OWN_IDS or any(word in strings for word in _OWN_WORDS)


def _by_id() -> dict[str, str]:
    return {os.path.realpath(link): str(link) for link in sorted(BY_ID.glob("*"), reverse=True)}


def usb_places() -> list[Place]:
    """Return the USB boards.

    Raises
    ------
    LinkUnavailableError
        libusb cannot be loaded.
    """
    from resonator_daemon.links.usb_devices import present_boards  # loads libusb

    places = []
    for board in present_boards():
        holders = port_holders(board.node)
        places.append(
            Place(
                link=board.link,
                kind="usb",
                device=board.node,
                by_id=None,
                usb_id=f"{board.vendor_id:04x}:{board.product_id:04x}",
                serial_number=board.serial_number,
                description=None,
                held_by=holders.processes,
                held_by_all_seen=holders.all_seen,
                permitted=os.access(board.node, os.R_OK | os.W_OK),
                looks_like_a_board=True,  # its interface is of a board's class
            )
        )
    return places
