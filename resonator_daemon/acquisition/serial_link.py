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
    except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError, termios.error is none
        raise LinkUnavailableError(_why_not(target, error)) from error
    descriptor = port.fileno()
    try:
        fcntl.ioctl(descriptor, termios.TIOCEXCL)
    except OSError as error:
        port.close()
        raise LinkUnavailableError(f"{target.path} went away while it was opened ({error.strerror})") from error

    def close() -> None:
        if port.is_open:  # the descriptor is still this port's
            with suppress(OSError):
                # A pseudo-terminal that its other side keeps alive would stay shut to all but root.
                fcntl.ioctl(descriptor, termios.TIOCNXCL)
        with suppress(OSError, termios.error):
            port.close()

    return FileDescriptorLink(descriptor, close)


def _why_not(target: SerialLink, error: Exception) -> str:
    # Where a port's settings cannot be read, only the exception behind pyserial's own has the number.
    cause = error.__context__ if isinstance(error.__context__, termios.error) else error
    code = cause.args[0] if isinstance(cause, termios.error) else getattr(cause, "errno", None)
    if code == errno.ENOENT or not os.path.exists(target.path):
        return f"no port {target.path}; {_present()}"
    if code in (errno.EACCES, errno.EPERM):
        return f"{target.path} may not be opened by this user; join the group {_group(target.path)}"
    if code in (errno.EBUSY, errno.EAGAIN):
        return f"{target.path} is held by another program; close it there"
    if code == errno.ENOTTY:
        return f"{target.path} is no serial port; {_present()}"
    if isinstance(error, ValueError):
        return f"{target.path} cannot be set to {target.baud} baud; choose a rate that its driver knows"
    return f"{target.path} cannot be opened: {error}"


def _group(path: str) -> str:
    try:
        return Path(path).group()
    except KeyError:  # a group without a name, as in a container
        return str(os.stat(path).st_gid)


def _present() -> str:
    by_id = sorted(str(path) for path in Path("/dev/serial/by-id").glob("*"))
    present = by_id or sorted(port.device for port in list_ports.comports())
    return f"present: {', '.join(present)}" if present else "no serial port is present"
