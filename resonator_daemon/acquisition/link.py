"""What a link is, and the file-descriptor link that serial ports and sockets share."""

import os
import select
import time
from collections.abc import Callable
from typing import Protocol

_READ_BYTES = 1 << 18
_WRITE_TIMEOUT_S = 1.0


class LinkUnavailableError(Exception):
    """The link cannot be opened now; the text says which, why, and what is there instead."""


class LinkLostError(Exception):
    """An open link went away, as when a cable is pulled."""


class Link(Protocol):
    """A two-way stream of bytes to a board."""

    def read(self, timeout_s: float) -> bytes:
        """Return what has come, waiting at most `timeout_s`; empty when nothing has. Raises LinkLostError."""

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises LinkLostError."""

    def close(self) -> None:
        """Give the port back; never fails."""


class FileDescriptorLink:
    """A link over a non-blocking file descriptor; an error, a hang-up and an end of file all mean unplugged."""

    def __init__(self, descriptor: int, close: Callable[[], None]) -> None:
        self._descriptor = descriptor
        self._close = close
        self._readable = select.poll()
        self._readable.register(descriptor, select.POLLIN)
        self._writable = select.poll()
        self._writable.register(descriptor, select.POLLOUT)

    def read(self, timeout_s: float) -> bytes:
        if not self._readable.poll(timeout_s * 1e3):
            return b""
        try:
            data = os.read(self._descriptor, _READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LinkLostError(f"unplugged ({error.strerror})") from error
        if not data:
            raise LinkLostError("unplugged (end of stream)")
        return data

    def write(self, data: bytes) -> None:
        deadline = time.monotonic() + _WRITE_TIMEOUT_S
        while data:
            left_s = deadline - time.monotonic()
            if left_s < 0 or not self._writable.poll(left_s * 1e3):
                raise LinkLostError(f"the board took no bytes for {_WRITE_TIMEOUT_S:g} s")
            try:
                data = data[os.write(self._descriptor, data) :]
            except BlockingIOError:
                continue
            except OSError as error:
                raise LinkLostError(f"unplugged ({error.strerror})") from error

    def close(self) -> None:
        self._close()
