"""Connecting to a board, or an emulator, that listens on TCP."""

import socket

from resonator_daemon.acquisition.link import FileDescriptorLink, LinkUnavailableError
from resonator_daemon.config import TcpLink

_CONNECT_TIMEOUT_S = 3.0


def open_tcp(target: TcpLink) -> FileDescriptorLink:
    """Connect.

    Raises
    ------
    LinkUnavailableError
        When nobody listens there or the host is not known.
    """
    try:
        connection = socket.create_connection((target.host, target.port), timeout=_CONNECT_TIMEOUT_S)
    except (OSError, UnicodeError) as error:  # UnicodeError: no host can have such a name
        raise LinkUnavailableError(f"tcp://{target.host}:{target.port} does not answer ({error})") from error
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setblocking(False)
    return FileDescriptorLink(connection.fileno(), connection.close)
