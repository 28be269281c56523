"""Connecting to a board, or an emulator, that listens on TCP.

The reader's thread polls the socket as it polls a serial port: an event loop would only put a second thread between
them, and pyserial's `socket://` drops bytes that it has received already when the peer closes.
"""

import os
import socket
import time

from resonator_daemon.config import TcpLink
from resonator_daemon.links.host_lookup import resolve_host
from resonator_daemon.links.link import FileDescriptorLink, LinkUnavailableError

_CONNECT_TIMEOUT_S = 3.0  # for the name and all its addresses together

# A peer that vanished without a word, as with its power, is told by the kernel after four seconds.
_IDLE_S, _PROBE_S, _PROBES = 1, 1, 3
_UNACKNOWLEDGED_MS = 4000


def open_tcp(target: TcpLink) -> FileDescriptorLink:
    """Connect.

    Raises
    ------
    LinkUnavailableError
        When the host is not known or not found in time, nobody listens there, or nobody answers.
    """
    deadline = time.monotonic() + _CONNECT_TIMEOUT_S
    reasons = []
    try:
        for family, address in resolve_host(target.host, target.port, _CONNECT_TIMEOUT_S):
            try:
                connection = _connect(family, address, deadline - time.monotonic())
            except OSError as error:
                reasons.append(f"{address[0]!s}: {_reason(error)}")
            else:
                return FileDescriptorLink(connection.fileno(), connection.close)
    except (OSError, UnicodeError) as error:  # UnicodeError: no host can have such a name
        raise LinkUnavailableError(f"{target} does not answer: no such host ({_reason(error)})") from error
    raise LinkUnavailableError(f"{target} does not answer ({'; '.join(reasons)})")


def _connect(family: int, address: tuple[str | int | bytes, ...], timeout_s: float) -> socket.socket:
    connection = socket.socket(family, socket.SOCK_STREAM)
    try:
        connection.settimeout(max(timeout_s, 1e-3))
        connection.connect(address)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _IDLE_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, _PROBE_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _PROBES)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNACKNOWLEDGED_MS)
        connection.setblocking(False)
    except OSError:
        connection.close()
        raise
    return connection


def _reason(error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return str(error) if error.errno is None and str(error) != "timed out" else "no answer in time"
    if isinstance(error, OSError) and error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return str(getattr(error, "strerror", None) or error)
