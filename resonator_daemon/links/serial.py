"""Opening a serial port, and saying clearly why it cannot be opened."""

import array
import errno
import fcntl
import os
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import serial
from serial.tools import list_ports

from resonator_daemon.config import SerialLink
from resonator_daemon.links.link import FileDescriptorLink, LinkUnavailableError
from resonator_daemon.links.port_holders import is_pseudo_terminal, port_holders
from resonator_daemon.links.tty_settings import configure_tty, overrun_counter, set_low_latency

_LAST_BYTES_S = 0.05


class SerialPortLink(FileDescriptorLink):
    """A serial port that this process holds alone."""

    def __init__(self, descriptor: int, close: Callable[[], None]) -> None:
        super().__init__(descriptor, close)
        self._count_overruns = overrun_counter(descriptor)
        self._overruns = 0

    @property
    def overruns(self) -> int:
        if self._close is not None:
            self._overruns = self._count_overruns()
        return self._overruns


def open_serial(target: SerialLink) -> SerialPortLink:
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
        raise LinkUnavailableError(_why_not(target, error)) from error
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
        raise LinkUnavailableError(f"{target.path} went away while it was opened ({error.args[-1]})") from error
    if sharing := _shared_with(target.path):
        close()
        raise LinkUnavailableError(f"{target.path} is also held by {sharing}; each would get some of the bytes")
    set_low_latency(descriptor, target.path)
    return SerialPortLink(descriptor, close)


def _discard_output(descriptor: int) -> None:
    """Give the last bytes a moment; what a board has not taken by then is dropped, or closing would wait for it."""
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


def _shared_with(path: str) -> str:
    # Root may open a port in spite of TIOCEXCL, and who opened it before us without a lock has it still.
    if is_pseudo_terminal(path):
        return ""  # its other side holds it rightly
    return " and ".join(str(holder) for holder in port_holders(path).processes if holder.pid != os.getpid())


def _why_not(target: SerialLink, error: Exception) -> str:
    # Where a port's settings cannot be read, only the exception behind pyserial's own has the number.
    cause = error.__context__ if isinstance(error.__context__, termios.error) else error
    code = cause.args[0] if isinstance(cause, termios.error) else getattr(cause, "errno", None)
    if code == errno.ENOENT or not os.path.exists(target.path):
        return f"no port {target.path}; {_present()}"
    if code in (errno.EACCES, errno.EPERM):
        return f"{target.path} may not be opened by this user; {_way_in(target.path)}"
    if code in (errno.EBUSY, errno.EAGAIN):
        return f"{target.path} is held by {_holder(target.path)}"
    if code in (errno.ENOTTY, errno.EISDIR):
        return f"{target.path} is no serial port; {_present()}"
    if code in (errno.ENXIO, errno.ENODEV, errno.EIO):
        return f"{target.path} is there and its device is not ({os.strerror(code)}); plug it in"
    if isinstance(error, ValueError):
        return f"{target.path} cannot be set to {target.baud} baud; choose a rate that its driver knows"
    return f"{target.path} cannot be opened: {os.strerror(code) if code else error}"


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
        group = ""
    if group in ("", "root"):
        return "give it to a group of this user with a udev rule (docs/links.md)"
    return f"join its group: sudo usermod -aG {group} $USER, then log in anew"


def _present() -> str:
    by_id = sorted(str(path) for path in Path("/dev/serial/by-id").glob("*"))
    present = by_id or sorted(port.device for port in list_ports.comports())
    return f"present: {', '.join(present)}" if present else "no serial port is present"
