"""Interfaces to systemd: notifications to the service manager, and log lines in the journal."""

import logging
import os
import socket
import struct
import sys
import time
from collections.abc import Mapping
from pathlib import Path

_STATUS_BYTES_MAX = 1000  # the manager reads 4096 bytes of a message


class ServiceManager:
    """Notifications to the manager that started this process, if any; never waits and never raises.

    What the manager's queue has no room for is sent with the next message.

    Parameters
    ----------
    environment
        As given by the manager: `NOTIFY_SOCKET`, `WATCHDOG_USEC` and `WATCHDOG_PID`.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path if path.startswith("/") else None
        self._unsent: dict[str, str] = {}
        self._status = ""
        self.watchdog_s = _watchdog_s(environment) if self._address else None

    def ready(self, status: str) -> None:
        """Report that the start, or a reload, is complete."""
        self._unsent.pop("RELOADING", None)
        self._unsent.pop("MONOTONIC_USEC", None)
        self._send(READY="1", STATUS=_one_line(status))

    def status(self, text: str) -> None:
        """Report a status line; a repeated text is sent once."""
        if (line := _one_line(text)) != self._status:
            self._send(STATUS=line)

    def alive(self) -> None:
        """Feed the watchdog; due every `watchdog_s`."""
        self._send(WATCHDOG="1")

    def reloading(self) -> None:
        """Report that the configuration is being reloaded; `ready` ends it."""
        self._unsent.pop("READY", None)
        self._send(RELOADING="1", MONOTONIC_USEC=str(time.monotonic_ns() // 1000))

    def stopping(self) -> None:
        """Report that the process is stopping."""
        self._send(STOPPING="1")

    def _send(self, **variables: str) -> None:
        if self._address is None:
            return
        self._status = variables.get("STATUS", self._status)
        self._unsent.update(variables)
        message = "\n".join(f"{name}={value}" for name, value in self._unsent.items())
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sending:
                sending.sendto(message.encode(), self._address)
        except OSError:
            return
        self._unsent.clear()


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """Return half the time after which the manager restarts a silent process; None where it does not."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None  # the watchdog is of another process, such as the parent
    try:
        timeout_us = int(environment.get("WATCHDOG_USEC", ""))
    except ValueError:
        return None
    return timeout_us * 0.5e-6 if timeout_us > 0 else None


def _one_line(text: str) -> str:
    """Return the text without line breaks, so that it cannot set another variable."""
    line = "".join(sign if sign.isprintable() else " " for sign in text)
    return line.encode(errors="replace")[:_STATUS_BYTES_MAX].decode(errors="ignore")


JOURNAL = Path("/run/systemd/journal/socket")

_IDENTIFIER = "resonatord"
_FIELD = "resonatord_"  # attributes of a record, by `extra=`, that become fields of the line
_VALUE_BYTES_MAX = 32_768  # what a datagram takes with certainty, however many fields there are
_PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
_DEBUG = 7


def set_up_logging(level: int = logging.INFO, journal: Path = JOURNAL) -> None:
    """Send the log lines of this process to the journal or to stderr."""
    plain = logging.StreamHandler(sys.stderr)
    plain.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    connection = _connect(journal) if _stderr_is_journal(os.environ) else None
    logging.basicConfig(level=level, handlers=[JournalHandler(connection, plain) if connection else plain])


def tag_log(name: str) -> None:
    """Add the daemon's name to all further lines in the journal."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, JournalHandler):
            handler.tag_log(name)


def error_prefix() -> str:
    """Return the prefix that marks a line on stderr as an error in the journal; empty for other outputs."""
    return "<3>" if _stderr_is_journal(os.environ) else ""


class JournalHandler(logging.Handler):
    """Log handler that writes the journal's native protocol (systemd.io/JOURNAL_NATIVE_PROTOCOL) and never waits.

    A line that finds the journal's queue full is lost; the next one that does not carries their number, in
    `RESONATORD_LINES_LOST`. A value of more than 32 kB is cut off.

    Parameters
    ----------
    connection
        To the journal's socket, not blocking.
    fallback
        Takes the lines of a journal that has gone.
    """

    def __init__(self, connection: socket.socket, fallback: logging.Handler) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("%(message)s"))
        self._connection = connection
        self._fallback = fallback
        self._lost = 0
        self._common: dict[str, str] = {"SYSLOG_IDENTIFIER": _IDENTIFIER}

    def tag_log(self, name: str) -> None:
        self._common["RESONATORD_NAME"] = name

    def close(self) -> None:
        self._connection.close()
        super().close()

    def emit(self, record: logging.LogRecord) -> None:
        try:
            fields = self._common | _fields(record, self.format(record))
            if self._lost:
                fields["RESONATORD_LINES_LOST"] = str(self._lost)
            self._connection.send(b"".join(_encoded(name, value) for name, value in fields.items()))
            self._lost = 0
        except BlockingIOError:
            self._lost += 1
        except OSError:
            self._fallback.handle(record)
        except Exception:  # noqa: BLE001 - as every handler of the standard library: a log line ends no program
            self.handleError(record)


def _fields(record: logging.LogRecord, message: str) -> dict[str, str]:
    fields = {
        "MESSAGE": message,
        "PRIORITY": str(next((priority for level, priority in _PRIORITIES if record.levelno >= level), _DEBUG)),
        "CODE_FILE": record.pathname,
        "CODE_LINE": str(record.lineno),
        "CODE_FUNC": record.funcName or "",
        "RESONATORD_MODULE": record.name,
        "RESONATORD_THREAD": record.threadName or "",
    }
    extra: Mapping[str, object] = vars(record)
    return fields | {name.upper(): str(value) for name, value in extra.items() if name.startswith(_FIELD)}


def _encoded(name: str, value: str) -> bytes:
    """Return a field in the journal's format: a value of several lines is preceded by its length."""
    # With other control characters in it, a line is shown as so many bytes of a blob.
    shown = "".join(sign if sign in "\t\n" or sign.isprintable() else ascii(sign)[1:-1] for sign in value)
    data = shown.encode(errors="backslashreplace")[:_VALUE_BYTES_MAX].decode(errors="ignore").encode()
    if b"\n" in data:
        return name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"
    return name.encode() + b"=" + data + b"\n"


def _stderr_is_journal(environment: Mapping[str, str]) -> bool:
    """Return whether stderr still is the journal's stream (systemd.exec(5), JOURNAL_STREAM)."""
    try:
        there = os.fstat(2)
    except OSError:
        return False
    return environment.get("JOURNAL_STREAM") == f"{there.st_dev}:{there.st_ino}"


def _connect(journal: Path) -> socket.socket | None:
    """Return a connection to the journal; None if there is no journal."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    try:
        connection.connect(str(journal))
    except OSError:
        connection.close()
        return None
    return connection
