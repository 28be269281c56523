"""Targets that `link` in a configuration names: serial port, TCP address, USB device, recording."""

import re
from dataclasses import dataclass
from urllib.parse import parse_qsl, quote

from resonator_daemon.config.mqtt import split_url
from resonator_daemon.toml_files.reading import nearest


@dataclass(frozen=True)
class SerialLink:
    """A board on a serial port."""

    path: str
    baud: int

    def __str__(self) -> str:
        return f"serial:{self.path}?baud={self.baud}"


@dataclass(frozen=True)
class TcpLink:
    """A board that listens on the network."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"


@dataclass(frozen=True)
class UsbLink:
    """A board on a USB bus; without a serial number the only one of its vendor and product."""

    vendor_id: int
    product_id: int
    serial_number: str | None = None
    reset: bool = False  # whether the device may be reset as the last step, when it stays silent

    def __str__(self) -> str:
        options = {"serial": self.serial_number, "reset": "yes" if self.reset else None}
        query = "&".join(f"{key}={quote(value, safe='')}" for key, value in options.items() if value is not None)
        return f"usb:{self.vendor_id:04x}:{self.product_id:04x}" + (f"?{query}" if query else "")


@dataclass(frozen=True)
class ReplayLink:
    """A recording of a link, in place of one."""

    path: str

    def __str__(self) -> str:
        return f"replay:{self.path}"


LinkTarget = SerialLink | TcpLink | UsbLink | ReplayLink


def parse_link(text: object) -> LinkTarget:
    """Parse `serial:PATH?baud=N`, `tcp://host:port`, `usb:VID:PID?serial=S`, `replay:FILE`.

    Raises ValueError with the fault.
    """
    if isinstance(text, LinkTarget):
        return text
    if not isinstance(text, str):
        raise ValueError("must be a string: serial:PATH?baud=N, tcp://host:port, usb:VID:PID?serial=S or replay:FILE")
    scheme, _, rest = text.partition(":")
    match scheme:
        case "serial":
            return _serial_link(rest)
        case "tcp":
            url = split_url(text)
            if not url.hostname or url.port is None or url.netloc.count("@") or url.path or url.query or url.fragment:
                raise ValueError("must be tcp://host:port, nothing more")
            return TcpLink(url.hostname, url.port)
        case "usb":
            return _usb_link(rest)
        case "replay":
            if not rest or "\0" in rest:
                raise ValueError("must be replay:FILE, a file that `resonatord record` has written")
            return ReplayLink(rest)
        case _ if text.startswith("/dev/"):
            raise ValueError("must say what kind of link it is and how fast, as serial:/dev/ttyACM0?baud=4000000")
        case _:
            raise ValueError(f"no link is called {scheme!r}; {nearest(scheme, ['serial', 'tcp', 'usb', 'replay'])}")


def _serial_link(rest: str) -> SerialLink:
    path, _, query = rest.partition("?")
    baud = _options(query, ["baud"]).get("baud", "")
    if not path or "\0" in path or not (baud.isascii() and baud.isdecimal() and 0 < int(baud[:12]) <= 1e9):
        raise ValueError("must be serial:PATH?baud=N with N from 1 to 1e9, as serial:/dev/ttyACM0?baud=4000000")
    return SerialLink(path, int(baud))


def _usb_link(rest: str) -> UsbLink:
    ids, question, query = rest.partition("?")
    found = re.fullmatch(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})", ids)
    if found is None or (question and not query):
        raise ValueError(
            "must be usb:VID:PID?serial=S, ids of four hexadecimal digits as lsusb shows them, "
            "as usb:1209:0001?serial=0042"
        )
    options = _options(query, ["serial", "reset"])
    serial_number = options.get("serial")
    if serial_number is not None and (not serial_number.isprintable() or not 0 < len(serial_number) <= 126):
        raise ValueError("serial must be 1 to 126 printable characters, as in the device's string descriptor")
    if (reset := options.get("reset", "no")) not in ("yes", "no"):
        raise ValueError(f"reset must be yes or no, got {reset!r}")
    return UsbLink(int(found[1], 16), int(found[2], 16), serial_number, reset == "yes")


def _options(query: str, allowed: list[str]) -> dict[str, str]:
    """Return the options of a link, each named once."""
    pairs = parse_qsl(query, keep_blank_values=True)
    for position, (key, _) in enumerate(pairs):
        if key not in allowed:
            raise ValueError(f"no option is called {key!r}; {nearest(key, allowed)}")
        if key in (other for other, _ in pairs[:position]):
            raise ValueError(f"{key} is given twice")
    return dict(pairs)
