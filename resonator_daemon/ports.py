"""`resonatord ports`: what a board may be connected to, and the line of a configuration that names it."""

import json
import os
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from serial.tools.list_ports_common import ListPortInfo

from resonator_daemon.links.link import LinkUnavailableError
from resonator_daemon.links.port_holders import Holder, port_holders
from resonator_daemon.links.port_identity import serial_ports

_BY_ID = Path("/dev/serial/by-id")
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


def list_places(*, as_json: bool) -> None:
    """Print the places; people get a sentence on stderr where there is none."""
    places = _serial_places()
    try:
        places += _usb_places()
    except LinkUnavailableError as error:
        sys.stderr.write(f"resonatord: USB boards are not listed: {error}\n")
    if as_json:
        sys.stdout.write(json.dumps({"verb": "ports", "ports": [_as_json(place) for place in places]}) + "\n")
        return
    for place in places:
        about = " ".join(filter(None, (place.usb_id, place.serial_number, place.description)))
        sys.stdout.write(f"{place.device}  {about or 'says nothing of itself'}\n")
        for note in _notes(place):
            sys.stdout.write(f"    {note}\n")
        sys.stdout.write(f'    link = "{place.link}"\n')
    if not all(place.held_by_all_seen for place in places):
        who = "sees more" if os.geteuid() else "outside of this container sees more"
        sys.stderr.write(f"programs that this user may not look at are not shown as holders; root {who}\n")
    if not places:
        sys.stderr.write("no serial port and no USB board is present; plug one in, or try: resonatord emulate --help\n")


def _as_json(place: Place) -> dict[str, Any]:
    return {**asdict(place), "held_by": [{"pid": holder.pid, "name": holder.name} for holder in place.held_by]}


def _notes(place: Place) -> list[str]:
    notes = []
    if place.looks_like_a_board:
        notes.append("looks like a board; to be sure: resonatord identify")
    if place.held_by:
        notes.append(f"held by {' and '.join(str(holder) for holder in place.held_by)}")
    if not place.permitted:
        notes.append("may not be opened by this user; see docs/links.md")
    return notes


def _serial_places() -> list[Place]:
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
    return {os.path.realpath(link): str(link) for link in sorted(_BY_ID.glob("*"), reverse=True)}


def _usb_places() -> list[Place]:
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
