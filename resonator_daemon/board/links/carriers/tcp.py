"""Connecting to a board, or an emulator, that listens on TCP.

The reader's thread polls the socket as it polls a serial port: an event loop would only put a second thread between
them, and pyserial's `socket://` drops bytes that it has received already when the peer closes.
"""

import socket
import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Final, Self

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.host.text import page
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.base.toml import split_url
from resonator_daemon.board.links.link import FileDescriptorLink, LinkUnavailableError
from resonator_daemon.board.links.target import LinkTarget

CONNECT_TIMEOUT_S = 3.0

# The kernel reports a peer that vanished, as with its power, after four seconds.
_IDLE_S, _PROBE_S, _PROBES = 1, 1, 3
UNACKNOWLEDGED_MS = 4000

_REFUSAL: Final = Reason(
    ReasonCode.PORT_IN_USE,
    "the board closed the connection before it sent a byte: it serves one program at a time; "
    "stop the one that it serves, such as a running daemon (resonatord status lists those of this computer)",
)


@dataclass(frozen=True)
class TcpTarget(LinkTarget):
    """A board that listens on the network."""

    scheme = "tcp"
    syntax = "tcp://host:port"
    is_remote = True

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"

    @classmethod
    def parse(cls, text: str) -> Self:
        url = split_url(text)
        if not url.hostname or url.port is None or url.netloc.count("@") or url.path or url.query or url.fragment:
            raise ValueError("must be tcp://host:port, nothing more")
        return cls(url.hostname, url.port)

    def open(self) -> FileDescriptorLink:
        return open_tcp(self)

    @property
    def remedy(self) -> str:
        return (
            f"see that what should listen at {self.host} port {self.port} is switched on and in the network "
            f"(ping {self.host}), that address and port are right, and that no firewall is in between; "
            + page("how-to/connect.md")
        )


def open_tcp(
    target: TcpTarget, timeout_s: float = CONNECT_TIMEOUT_S, unacknowledged_ms: int = UNACKNOWLEDGED_MS
) -> FileDescriptorLink:
    """Connect.

    Parameters
    ----------
    timeout_s
        For the name and all its addresses together.
    unacknowledged_ms
        After which the link is lost when the peer acknowledges nothing.

    Raises
    ------
    LinkUnavailableError
        When the host is not known or not found in time, nobody listens there, or nobody answers.
    """
    deadline = time.monotonic() + timeout_s
    code, failures = ReasonCode.HOST_UNKNOWN, []
    try:
        for family, address in resolve_host(target.host, target.port, timeout_s):
            try:
                connection = connect(family, address, deadline - time.monotonic(), unacknowledged_ms)
            except OSError as error:
                refused = isinstance(error, ConnectionRefusedError)
                code = ReasonCode.CONNECTION_REFUSED if refused else ReasonCode.HOST_UNREACHABLE
                failures.append(f"{address[0]!s}: {meaning_of(error)}")
            else:
                return FileDescriptorLink(connection.fileno(), connection.close, _REFUSAL)
    except (OSError, UnicodeError) as error:  # UnicodeError: no host can have such a name
        raise LinkUnavailableError(
            ReasonCode.HOST_UNKNOWN, f"{target} does not answer: no such host ({meaning_of(error)})"
        ) from error
    raise LinkUnavailableError(code, f"{target} does not answer ({'; '.join(failures)})")


def connect(
    family: int, address: tuple[str | int | bytes, ...], timeout_s: float, unacknowledged_ms: int
) -> socket.socket:
    connection = socket.socket(family, socket.SOCK_STREAM)
    try:
        connection.settimeout(max(timeout_s, 1e-3))
        connection.connect(address)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _IDLE_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, _PROBE_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _PROBES)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, unacknowledged_ms)
        connection.setblocking(False)
    except OSError:
        connection.close()
        raise
    return connection


Addresses = list[tuple[int, tuple[str | int | bytes, ...]]]  # of version 6 with the interface it belongs to

_under_way: dict[tuple[str, int], Future[Addresses]] = {}
_guard = threading.Lock()


def resolve_host(host: str, port: int, timeout_s: float) -> Addresses:
    """Return families and addresses; a look-up that took too long goes on, and its answer serves the next call.

    Raises
    ------
    OSError
        The host is not known; TimeoutError when the resolver does not answer in time.
    UnicodeError
        No host can have such a name.
    """
    with _guard:
        answer = _under_way.get((host, port))
        if answer is None:
            answer = Future()
            # No pool: those of concurrent.futures are waited for when the process ends.
            threading.Thread(target=_resolve, args=(host, port, answer), name="look-up", daemon=True).start()
            _under_way[host, port] = answer
    try:
        return answer.result(timeout_s)
    except TimeoutError:
        if answer.done():
            raise
        raise TimeoutError(f"its name was not found within {timeout_s:g} s") from None
    finally:
        if answer.done():
            with _guard:
                _under_way.pop((host, port), None)


def _resolve(host: str, port: int, answer: Future[Addresses]) -> None:
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        answer.set_result([(family, address) for family, _, _, _, address in found])
    except Exception as error:  # noqa: BLE001 - raised where the answer is awaited, which would be for ever
        answer.set_exception(error)
