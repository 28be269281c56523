"""Interface of links, and the file-descriptor link that serial ports and sockets share."""

import errno
import os
import select
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Protocol

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.reasons import Reason, ReasonCode

WRITE_TIMEOUT_S = 1.0  # in which a board must take what it is sent

_READ_BYTES = 1 << 18  # about this much a call, so that a flood is handed on in pieces
_TERMINAL_BYTES, _TERMINAL_BYTES_MAX = 2048, 4096  # a terminal with more waiting never gives less, nor ever more
_SELECT_LIMIT = 1024  # descriptors that select can wait for
_CLOSED = frozenset({errno.ECONNRESET, errno.EPIPE})  # by the other end, as an end of the stream
_BROKEN = select.POLLERR | select.POLLHUP | select.POLLNVAL
_UNPLUGGED: Final = Reason(ReasonCode.UNPLUGGED, "unplugged")

CLOSED_HERE: Final = Reason(ReasonCode.STOPPED, "closed here")


class LinkError(Exception):
    """A link is not there, with the reason."""

    def __init__(self, code: ReasonCode, text: str) -> None:
        super().__init__(text)
        self.reason = Reason(code, text)


class LinkUnavailableError(LinkError):
    """The link cannot be opened now; the text has which, why, and what is there instead."""


class LinkLostError(LinkError):
    """An open link went away, as when a cable is pulled."""


class Link(Protocol):
    """A two-way stream of bytes to a board."""

    @property
    def overruns(self) -> int:
        """How often the host's own kernel has lost bytes since the link was opened; 0 where it does not count."""

    def read(self, timeout_s: float) -> bytes:
        """Return what has come, waiting at most `timeout_s`; empty when nothing has. Raises LinkLostError."""

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises LinkLostError."""

    def close(self) -> None:
        """Give the port back; never fails, and never waits for the board."""


def write_timeout() -> LinkLostError:
    return LinkLostError(ReasonCode.WRITE_TIMEOUT, f"the board accepted no bytes for {WRITE_TIMEOUT_S:g} s")


class FileDescriptorLink:
    """A link over a non-blocking file descriptor; an error, a hang-up and an end of file all mean unplugged.

    Parameters
    ----------
    descriptor
        Non-blocking, open for reading and writing.
    close
        Gives the descriptor back; called once.
    refusal
        What a stream means that ends before a byte has come; None: unplugged, as later.
    """

    def __init__(self, descriptor: int, close: Callable[[], None], refusal: Reason | None = None) -> None:
        self._descriptor = descriptor
        self._close: Callable[[], None] | None = close
        self._ended = refusal or _UNPLUGGED  # until a byte has come
        self._lost: Reason | None = None
        self._buffer = memoryview(bytearray(_READ_BYTES))
        self._readable = select.poll()
        self._readable.register(descriptor, select.POLLIN)
        self._writable = select.poll()
        self._writable.register(descriptor, select.POLLOUT)

    @property
    def overruns(self) -> int:
        return 0

    def read(self, timeout_s: float) -> bytes:
        if self._lost is not None:
            self._check()
        if timeout_s > 0.0 and not self._wait(timeout_s):
            return b""
        data = self._drain()
        if not data and self._lost is None and any(state & _BROKEN for _, state in self._readable.poll(0)):
            self._lost = _with(self._ended, "hung up")  # the next wait would return at once again, for ever
        if not data:
            self._check()
        return data

    def write(self, data: bytes) -> None:
        self._check()
        deadline = time.monotonic() + WRITE_TIMEOUT_S
        while data:
            left_s = deadline - time.monotonic()
            if left_s < 0 or not self._writable.poll(left_s * 1e3):
                raise write_timeout()
            try:
                data = data[os.write(self._descriptor, data) :]
            except BlockingIOError:
                continue
            except OSError as error:
                raise LinkLostError(*self._error(error)) from error

    def close(self) -> None:
        close, self._close = self._close, None
        if close is not None:
            self._lost = self._lost or CLOSED_HERE
            close()

    def _wait(self, timeout_s: float) -> bool:
        # poll counts in whole milliseconds. Pings would leave on a grid of those behind the arrival of bytes, and where
        # these come in clumps, none would leave just before a clump, which gives the tightest bound of the time.
        if self._descriptor < _SELECT_LIMIT:
            with suppress(OSError):  # a closed descriptor, which poll reports in its own way
                return bool(select.select([self._descriptor], [], [], timeout_s)[0])
        return bool(self._readable.poll(timeout_s * 1e3))

    def _drain(self) -> bytes:
        """Read what is there: a terminal gives 4 kB a call. An end that is found behind bytes is kept for next time."""
        buffer = self._buffer
        size = 0
        while size < _READ_BYTES:
            try:
                piece_bytes = os.readv(self._descriptor, (buffer[size:],))
            except BlockingIOError:
                break
            except OSError as error:
                self._lost = self._error(error)
                break
            if not piece_bytes:
                self._lost = _with(self._ended, "end of stream")
                break
            self._ended = _UNPLUGGED
            size += piece_bytes
            if piece_bytes < _TERMINAL_BYTES or piece_bytes > _TERMINAL_BYTES_MAX:
                break  # a socket gives all that has come
        return bytes(buffer[:size])

    def _error(self, error: OSError) -> Reason:
        return _with(self._ended if error.errno in _CLOSED else _UNPLUGGED, meaning_of(error))

    def _check(self) -> None:
        # A closed descriptor's number may be somebody else's by now.
        if self._lost is not None:
            raise LinkLostError(*self._lost)


def _with(reason: Reason, detail: str) -> Reason:
    return Reason(reason.code, f"{reason.text} ({detail})")
