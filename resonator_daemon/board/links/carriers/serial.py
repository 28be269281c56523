"""Serial ports: opened for this process alone, or with the reason why that cannot be."""

import array
import errno
import fcntl
import logging
import os
import struct
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Self

import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.host.text import page
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.links.link import FileDescriptorLink, LinkUnavailableError
from resonator_daemon.board.links.port_holders import is_pseudo_terminal, port_holders
from resonator_daemon.board.links.target import FoundPort, LinkTarget, options_of

log = logging.getLogger(__name__)

_LAST_BYTES_S = 0.05
BY_ID = Path("/dev/serial/by-id")
_BAUD = 4_000_000  # proposed for a port that is found
_OWN_IDS = frozenset({(0x1209, 0x0001)})  # those that the installed udev rules name
_OWN_WORDS = ("resonat", "rd board")  # in the strings of a USB device
_TIOCGICOUNT = 0x545D
_COUNTS = struct.Struct("@20i")
_OVERRUN, _BUFFER_OVERRUN = 7, 10
SYS_TTY = Path("/sys/class/tty")
_logged: set[Path] = set()  # timers that were logged: once in the life of a process


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
        """Open a serial port for this process alone: raw, its modem lines left as they are, and nothing old in it.

        Raises
        ------
        LinkUnavailableError
            When the port does not exist, is held by another program, is not permitted or is no serial port.
        """
        try:
            # flock keeps out other programs that ask for it, TIOCEXCL those that do not.
            port = serial.Serial(self.path, self.baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError, termios.error is none
            raise LinkUnavailableError(*_why_not(self, error)) from error
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
                ReasonCode.NO_SUCH_PORT, f"{self.path} went away while it was opened ({error.args[-1]})"
            ) from error
        if sharing := _shared_with(self.path):
            close()
            raise LinkUnavailableError(
                ReasonCode.PORT_IN_USE, f"{self.path} is also held by {sharing}; each would get some of the bytes"
            )
        with suppress(ValueError):  # a driver without such a mode; its timer, if it has one, is set below
            port.set_low_latency_mode(True)
        shorten_latency_timer(self.path)
        return SerialPortLink(descriptor, close)

    def opener(self) -> Callable[[], "SerialPortLink"]:
        """Return a function that opens the port; an adapter that came back under another name is opened there."""
        adapter: PortIdentity | None = None

        def open_again() -> SerialPortLink:
            nonlocal adapter
            target = self
            if adapter is not None and (moved_to := find_port(adapter, self.path)):
                target = replace(self, path=moved_to)
            link = target.open()
            adapter = port_identity(target.path)
            return link

        return open_again

    def same_board(self, other: LinkTarget) -> bool:
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
        by_id = {os.path.realpath(link): str(link) for link in sorted(BY_ID.glob("*"), reverse=True)}
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


def find_port(identity: PortIdentity, configured: str) -> str | None:
    """Return the device that is this adapter now, as /dev/ttyACM1; None where it is not present.

    Parameters
    ----------
    identity
        From `port_identity`, while the port was there.
    configured
        The path that the configuration names. While there is something at it, or where it is a link that udev or an
        emulator keeps, the answer is None: what was named is what is meant.
    """
    if os.path.lexists(configured) or os.path.dirname(os.path.abspath(configured)) != "/dev":
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
        (port.device, PortIdentity(port.vid, port.pid, port.serial_number, (port.location or "").partition(":")[2]))
        for port in serial_ports()
        if port.vid is not None and port.pid is not None and port.serial_number
    ]


def configure_tty(descriptor: int) -> None:
    """Keep DTR as it is when the port is closed, and distinguish an empty port from one that is gone.

    Many boards restart when DTR falls and rises. With the minimum of 0 bytes that pyserial sets, a read that finds
    nothing returns no bytes, as does a read from a port that was hung up.
    """
    settings = termios.tcgetattr(descriptor)
    settings[2] &= ~termios.HUPCL
    settings[6][termios.VMIN] = 1
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)


def shorten_latency_timer(path: str, sys_tty: Path = SYS_TTY) -> None:
    """Set the timer of an adapter that collects bytes before it delivers them to 1 ms; log it where that fails."""
    name = os.path.basename(os.path.realpath(path))
    timer = sys_tty / name / "device" / "latency_timer"
    try:
        timer_ms = int(timer.read_text())
    except (OSError, ValueError):
        return  # no such adapter
    if timer_ms <= 1:
        return
    try:
        timer.write_text("1")
    except OSError as error:
        if timer not in _logged:
            _logged.add(timer)
            log.info(
                "%s delivers bytes only every %d ms (%s); a udev rule corrects it: "
                'ACTION=="add", SUBSYSTEM=="usb-serial", ATTR{latency_timer}="1"',
                path,
                timer_ms,
                meaning_of(error),
            )


def overrun_count(descriptor: int) -> int | None:
    """Return how often driver and terminal have lost bytes, modulo 2^32; None where they do not count."""
    counts = bytearray(_COUNTS.size)
    try:
        fcntl.ioctl(descriptor, _TIOCGICOUNT, counts)
    except OSError:
        return None
    values = _COUNTS.unpack(counts)
    return int(values[_OVERRUN]) + int(values[_BUFFER_OVERRUN])
