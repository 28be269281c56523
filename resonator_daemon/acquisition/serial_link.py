"""Opening a serial port, and saying clearly why it cannot be opened."""

import errno
import fcntl
import os
import termios
from contextlib import suppress
from pathlib import Path

import serial
from serial.tools import list_ports

from resonator_daemon.acquisition.link import FileDescriptorLink, LinkUnavailableError
from resonator_daemon.config import SerialLink


def open_serial(target: SerialLink) -> FileDescriptorLink:
    """Open a serial port for this process alone.

    Raises
    ------
    LinkUnavailableError
        When the port does not exist, is busy, is not permitted or is no serial port.
    """
    try:
        # flock keeps out other programs that ask for it, TIOCEXCL those that do not.
        port = serial.Serial(target.path, target.baud, timeout=0, exclusive=True)
    except (OSError, ValueError) as error:  # SerialException is an OSError
        raise LinkUnavailableError(_why_not(target, error)) from error
    descriptor = port.fileno()
    try:
        fcntl.ioctl(descriptor, termios.TIOCEXCL)
    except OSError as error:
        port.close()
        raise LinkUnavailableError(f"{target.path} went away while it was opened ({error.strerror})") from error

    def close() -> None:
        with suppress(OSError, termios.error):
            port.close()

    return FileDescriptorLink(descriptor, close)


def _why_not(target: SerialLink, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.ENOENT or not os.path.exists(target.path):
        return f"no port {target.path}; {_present()}"
    if code in (errno.EACCES, errno.EPERM):
        group = Path(target.path).group()
        return f"{target.path} may not be opened by this user; join the group {group}"
    if code in (errno.EBUSY, errno.EAGAIN):
        return f"{target.path} is held by another program; close it there"
    if isinstance(error, ValueError) or code == errno.ENOTTY:
        return f"{target.path} cannot be set to {target.baud} baud; is it a serial port?"
    return f"{target.path} cannot be opened: {error}"


def _present() -> str:
    by_id = sorted(str(path) for path in Path("/dev/serial/by-id").glob("*"))
    present = by_id or sorted(port.device for port in list_ports.comports())
    return f"present: {', '.join(present)}" if present else "no serial port is present"
