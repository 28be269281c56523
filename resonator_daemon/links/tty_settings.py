"""Settings of a terminal that pyserial leaves out: modem lines, low latency, counters of losses."""

import fcntl
import logging
import os
import struct
import termios
from collections.abc import Callable
from pathlib import Path

log = logging.getLogger(__name__)

_TIOCGSERIAL, _TIOCSSERIAL = 0x541E, 0x541F
_SERIAL_STRUCT_BYTES = 72
_FLAGS = struct.Struct("@i")
_FLAGS_AT = 16
_ASYNC_LOW_LATENCY = 1 << 13

_TIOCGICOUNT = 0x545D
_COUNTS = struct.Struct("@20i")
_OVERRUN, _BUFFER_OVERRUN = 7, 10

SYS_TTY = Path("/sys/class/tty")
_logged: set[Path] = set()  # timers that were logged: once in the life of a process


def configure_tty(descriptor: int) -> None:
    """Keep DTR as it is when the port is closed, and tell an empty port from one that is gone.

    Many boards start anew when DTR falls and rises. With the minimum of 0 bytes that pyserial sets, a read that finds
    nothing returns no bytes, as does a read from a port that was hung up.
    """
    settings = termios.tcgetattr(descriptor)
    settings[2] &= ~termios.HUPCL
    settings[6][termios.VMIN] = 1
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)


def set_low_latency(descriptor: int, path: str, sys_tty: Path = SYS_TTY) -> None:
    """Ask an adapter to deliver bytes at once instead of collecting them; log it where that fails."""
    try:
        serial = bytearray(_SERIAL_STRUCT_BYTES)
        fcntl.ioctl(descriptor, _TIOCGSERIAL, serial)
        flags = _FLAGS.unpack_from(serial, _FLAGS_AT)[0]
        _FLAGS.pack_into(serial, _FLAGS_AT, flags | _ASYNC_LOW_LATENCY)
        fcntl.ioctl(descriptor, _TIOCSSERIAL, bytes(serial))
    except OSError:
        pass  # a driver without this flag; its timer, if it has one, is set below
    name = os.path.basename(os.path.realpath(path))
    timer = sys_tty / name / "device" / "latency_timer"
    timer_ms = _latency_ms(timer)
    if timer_ms is None or timer_ms <= 1:
        return
    try:
        timer.write_text("1")
    except OSError as error:
        if timer not in _logged:
            _logged.add(timer)
            log.info(
                "%s hands bytes on only every %d ms (%s); a udev rule mends it: "
                'ACTION=="add", SUBSYSTEM=="usb-serial", ATTR{latency_timer}="1"',
                path,
                timer_ms,
                error.strerror,
            )


def overrun_counter(descriptor: int) -> Callable[[], int]:
    """Return a counter of the losses of driver and terminal since now; always 0 where they do not count."""
    first = _overruns(descriptor)
    if first is None:
        return lambda: 0
    last = 0

    def since() -> int:
        nonlocal last
        now = _overruns(descriptor)
        if now is not None:  # else the port went away; what was lost before stays lost
            last = (now - first) & 0xFFFFFFFF
        return last

    return since


def _latency_ms(timer: Path) -> int | None:
    try:
        return int(timer.read_text())
    except (OSError, ValueError):
        return None


def _overruns(descriptor: int) -> int | None:
    counts = bytearray(_COUNTS.size)
    try:
        fcntl.ioctl(descriptor, _TIOCGICOUNT, counts)
    except OSError:
        return None
    values = _COUNTS.unpack(counts)
    return int(values[_OVERRUN]) + int(values[_BUFFER_OVERRUN])
