"""Settings of a terminal that pyserial leaves out: modem lines, low latency, counters of losses."""

import fcntl
import logging
import os
import struct
import termios
from pathlib import Path

from resonator_daemon.base.errors import meaning_of

log = logging.getLogger(__name__)

_TIOCGICOUNT = 0x545D
_COUNTS = struct.Struct("@20i")
_OVERRUN, _BUFFER_OVERRUN = 7, 10

SYS_TTY = Path("/sys/class/tty")
_logged: set[Path] = set()  # timers that were logged: once in the life of a process


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
    timer_ms = _latency_ms(timer)
    if timer_ms is None or timer_ms <= 1:
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


def _latency_ms(timer: Path) -> int | None:
    try:
        return int(timer.read_text())
    except (OSError, ValueError):
        return None


def overrun_count(descriptor: int) -> int | None:
    """Return how often driver and terminal have lost bytes, modulo 2^32; None where they do not count."""
    counts = bytearray(_COUNTS.size)
    try:
        fcntl.ioctl(descriptor, _TIOCGICOUNT, counts)
    except OSError:
        return None
    values = _COUNTS.unpack(counts)
    return int(values[_OVERRUN]) + int(values[_BUFFER_OVERRUN])
