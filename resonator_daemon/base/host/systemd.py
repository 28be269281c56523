"""Notifications to the service manager: ready, alive, status (protocol of sd_notify(3))."""

import os
import socket
import time
from collections.abc import Mapping

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
