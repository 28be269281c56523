"""Serial ports: opened for this process alone, or with the reason why that cannot be."""

import array
import errno
import fcntl
import os
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.host.text import page
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.links.link import FileDescriptorLink, LinkUnavailableError
from resonator_daemon.board.links.port_holders import is_pseudo_terminal, port_holders
from resonator_daemon.board.links.port_identity import PortIdentity, find_port, port_identity, serial_ports
from resonator_daemon.board.links.target import FoundPort, LinkTarget, options_of
from resonator_daemon.board.links.tty_settings import configure_tty, overrun_count, shorten_latency_timer

_LAST_BYTES_S = 0.05
BY_ID = Path("/dev/serial/by-id")
_BAUD = 4_000_000  # proposed for a port that is found
_OWN_IDS = frozenset({(0x1209, 0x0001)})  # those that the installed udev rules name
_OWN_WORDS = ("resonat", "rd board")  # in the strings of a USB device


@dataclass(frozen=True)
class SerialTarget(LinkTarget):
    """A board on a serial port."""

    scheme = "serial"
    syntax = "serial:PATH?baud=N"

    path: str
    baud: int

    def __str__(self) -> str:
        return f"serial:{self.path}?baud={self.baud}"

    @classmethod
    def parse(cls, text: str) -> Self:
        path, _, query = text.partition(":")[2].partition("?")
        baud = options_of(query, ["baud"]).get("baud", "")
        if not path or "\0" in path or not (baud.isascii() and baud.isdecimal() and 0 < int(baud[:12]) <= 1e9):
            raise ValueError("must be serial:PATH?baud=N with N from 1 to 1e9, as serial:/dev/ttyACM0?baud=4000000")
        return cls(path, int(baud))

    def open(self) -> "SerialPortLink":
        return open_serial(self)

    def opener(self) -> Callable[[], "SerialPortLink"]:
        """Return a function that opens the port; an adapter that came back under another name is opened there."""
        adapter: PortIdentity | None = None

        def open_again() -> SerialPortLink:
            nonlocal adapter
            target = self
            if adapter is not None and (moved_to := find_port(adapter, self.path)):
                target = replace(self, path=moved_to)
            link = open_serial(target)
            adapter = port_identity(target.path)
            return link

        return open_again

    def leads_to_the_same(self, other: LinkTarget) -> bool:
        return other.serial_port is not None and os.path.realpath(self.path) == os.path.realpath(other.serial_port)

    @property
    def bits_per_s(self) -> int:
        return self.baud

    @property
    def appears_at(self) -> str:
        return self.path

    @property
    def serial_port(self) -> str:
        return self.path

    @classmethod
    def discover(cls) -> list[FoundPort]:
        by_id = _by_id()
        ports = []
        for port in serial_ports():
            path = by_id.get(os.path.realpath(port.device))
            holders = port_holders(port.device)
            ports.append(
                FoundPort(
                    link=str(cls(path or port.device, _BAUD)),
                    kind=cls.scheme,
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
        return ports


class SerialPortLink(FileDescriptorLink):
    """A serial port that this process holds alone."""

    def __init__(self, descriptor: int, close: Callable[[], None]) -> None:
        super().__init__(descriptor, close)
        self._overruns_before = overrun_count(descriptor)
        self._overruns = 0

    @property
    def overruns(self) -> int:
        if self._close is None or self._overruns_before is None:
            return self._overruns
        if (count := overrun_count(self._descriptor)) is not None:  # else the port went away
            self._overruns = (count - self._overruns_before) & 0xFFFFFFFF
        return self._overruns


def open_serial(target: SerialTarget) -> SerialPortLink:
    """Open a serial port for this process alone: raw, its modem lines left as they are, and nothing old in it.

    Raises
    ------
    LinkUnavailableError
        When the port does not exist, is held by another program, is not permitted or is no serial port.
    """
    try:
        # flock keeps out other programs that ask for it, TIOCEXCL those that do not.
        port = serial.Serial(target.path, target.baud, timeout=0, exclusive=True)
    except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError, termios.error is none
        raise LinkUnavailableError(*_why_not(target, error)) from error
    descriptor = port.fileno()

    def close() -> None:
        with suppress(OSError):
            # A pseudo-terminal that its other side keeps alive would stay shut to all but root.
            fcntl.ioctl(descriptor, termios.TIOCNXCL)
        with suppress(OSError, termios.error):
            _discard_output(descriptor)
        with suppress(OSError, termios.error):
            port.close()

    try:
        fcntl.ioctl(descriptor, termios.TIOCEXCL)
        configure_tty(descriptor)
        # Until the port was raw, the kernel may have sent back what the board had sent.
        termios.tcflush(descriptor, termios.TCOFLUSH)
    except (OSError, termios.error) as error:
        close()
        raise LinkUnavailableError(
            ReasonCode.NO_SUCH_PORT, f"{target.path} went away while it was opened ({error.args[-1]})"
        ) from error
    if sharing := _shared_with(target.path):
        close()
        raise LinkUnavailableError(
            ReasonCode.PORT_IN_USE, f"{target.path} is also held by {sharing}; each would get some of the bytes"
        )
    with suppress(ValueError):  # a driver without such a mode; its timer, if it has one, is set below
        port.set_low_latency_mode(True)
    shorten_latency_timer(target.path)
    return SerialPortLink(descriptor, close)


def _discard_output(descriptor: int) -> None:
    """Wait a moment until the last bytes are sent, then discard the rest, or closing would wait for it."""
    queued = array.array("i", [0])
    deadline = time.monotonic() + _LAST_BYTES_S
    while True:
        fcntl.ioctl(descriptor, termios.TIOCOUTQ, queued)
        if not queued[0]:
            return
        if time.monotonic() >= deadline:
            termios.tcflush(descriptor, termios.TCOFLUSH)
            return
        time.sleep(0.001)


def _shared_with(path: str) -> str | None:
    # Root may open a port in spite of TIOCEXCL, and who opened it before us without a lock has it still.
    if is_pseudo_terminal(path):
        return None  # its other side holds it rightly
    return " and ".join(str(holder) for holder in port_holders(path).processes if holder.pid != os.getpid())


def _why_not(target: SerialTarget, error: Exception) -> Reason:
    # Where a port's settings cannot be read, only the exception behind pyserial's own has the number.
    cause = error.__context__ if isinstance(error.__context__, termios.error) else error
    code = cause.args[0] if isinstance(cause, termios.error) else getattr(cause, "errno", None)
    if code == errno.ENOENT or not os.path.exists(target.path):
        return Reason(ReasonCode.NO_SUCH_PORT, f"no port {target.path}; {_present()}")
    if code in (errno.EACCES, errno.EPERM):
        way_in = _way_in(target.path)
        return Reason(ReasonCode.PERMISSION_DENIED, f"{target.path} may not be opened by this user; {way_in}")
    if code in (errno.EBUSY, errno.EAGAIN):
        return Reason(ReasonCode.PORT_IN_USE, f"{target.path} is held by {_holder(target.path)}")
    if code in (errno.ENOTTY, errno.EISDIR):
        return Reason(ReasonCode.PORT_UNUSABLE, f"{target.path} is no serial port; {_present()}")
    if code in (errno.ENXIO, errno.ENODEV, errno.EIO):
        absent = f"{target.path} is there and its device is not ({os.strerror(code)}); plug it in"
        return Reason(ReasonCode.NO_SUCH_PORT, absent)
    if isinstance(error, ValueError):
        rate = f"{target.path} cannot be set to {target.baud} baud; choose a rate that its driver supports"
        return Reason(ReasonCode.PORT_UNUSABLE, rate)
    return Reason(
        ReasonCode.PORT_UNUSABLE, f"{target.path} cannot be opened: {os.strerror(code) if code else meaning_of(error)}"
    )


def _holder(path: str) -> str:
    holders = port_holders(path)
    if holders.processes:
        return f"{holders}; close it there"
    if holders.all_seen:
        return "another program; close it there"
    return f"a program that this user may not look at; as root: fuser -v {path}"


def _way_in(path: str) -> str:
    try:
        group = Path(path).group()
    except (KeyError, OSError):  # a group without a name, as in a container; a port that has just gone
        group = None
    if group in (None, "root"):
        return f"give it to a group of this user with a udev rule ({page('how-to/connect.md')})"
    return f"join its group: sudo usermod -aG {group} $USER, then log in again"


def _present() -> str:
    by_id = sorted(str(path) for path in BY_ID.glob("*"))
    present = by_id or sorted(port.device for port in list_ports.comports())
    return f"present: {', '.join(present)}" if present else "no serial port is present"


def _looks_like_a_board(port: ListPortInfo) -> bool:
    strings = " ".join(filter(None, (port.manufacturer, port.product, port.description))).lower()
    return (port.vid, port.pid) in _OWN_IDS or any(word in strings for word in _OWN_WORDS)


def _by_id() -> dict[str, str]:
    return {os.path.realpath(link): str(link) for link in sorted(BY_ID.glob("*"), reverse=True)}
