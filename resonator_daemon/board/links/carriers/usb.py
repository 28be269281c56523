"""A board on a USB bus, with an interface of its own."""

import os
import re
from dataclasses import dataclass
from typing import Self
from urllib.parse import quote

from resonator_daemon.base.host.text import page
from resonator_daemon.board.links.link import Link
from resonator_daemon.board.links.port_holders import port_holders
from resonator_daemon.board.links.target import FoundPort, LinkTarget, UsbId, options_of


@dataclass(frozen=True)
class UsbTarget(LinkTarget):
    """A board on a USB bus."""

    scheme = "usb"
    syntax = "usb:VID:PID?serial=S"

    vendor_id: int
    product_id: int
    serial_number: str | None = None

    def __str__(self) -> str:
        query = "" if self.serial_number is None else f"?serial={quote(self.serial_number, safe='')}"
        return f"usb:{self.vendor_id:04x}:{self.product_id:04x}{query}"

    @classmethod
    def parse(cls, text: str) -> Self:
        ids, question, query = text.partition(":")[2].partition("?")
        found = re.fullmatch(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})", ids)
        if found is None or (question and not query):
            raise ValueError(
                "must be usb:VID:PID?serial=S, ids of four hexadecimal digits as lsusb shows them, "
                "as usb:1209:0001?serial=0042"
            )
        serial_number = options_of(query, ["serial"]).get("serial")
        if serial_number is not None and (not serial_number.isprintable() or not 0 < len(serial_number) <= 126):
            raise ValueError("serial must be 1 to 126 printable characters, as in the device's string descriptor")
        return cls(int(found[1], 16), int(found[2], 16), serial_number)

    def open(self) -> Link:
        from resonator_daemon.board.links.usb_link import open_usb  # loads libusb

        return open_usb(self)

    def same_board(self, other: LinkTarget) -> bool:
        if other.usb_id is None or self.usb_id[:2] != other.usb_id[:2]:
            return False
        numbers = (self.serial_number, other.usb_id.serial_number)
        return numbers[0] == numbers[1] or None in numbers

    @property
    def appears_at(self) -> str:
        return "/dev/bus/usb"

    @property
    def usb_id(self) -> UsbId:
        return UsbId(self.vendor_id, self.product_id, self.serial_number)

    @property
    def remedy(self) -> str:
        return "unplug the board and plug it in again, and see with `resonatord ports` whether it is there; " + page(
            "how-to/connect.md"
        )

    @classmethod
    def discover(cls) -> list[FoundPort]:
        from resonator_daemon.board.links.usb_link import present_boards

        ports = []
        for board in present_boards():
            holders = port_holders(board.node)
            ports.append(
                FoundPort(
                    link=board.link,
                    kind=cls.scheme,
                    device=board.node,
                    usb_id=f"{board.vendor_id:04x}:{board.product_id:04x}",
                    serial_number=board.serial_number,
                    held_by=holders.processes,
                    held_by_all_seen=holders.all_seen,
                    permitted=os.access(board.node, os.R_OK | os.W_OK),
                    looks_like_a_board=True,  # its interface is of a board's class
                )
            )
        return ports
