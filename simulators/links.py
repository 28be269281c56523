"""Links of an emulated board: a pseudo-terminal behind a stable name, and a TCP listener. Nothing here ever blocks."""

import math
import os
import socket
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from resonator_daemon.base.errors import ListenError

_BAUD = 4_000_000
_SPARE = 1.25  # of the bits of frames, for other messages
_READ_BYTES = 65536


class Link(Protocol):
    """One end of a wire that a host may or may not hold, and that can be pulled out."""

    @property
    def address(self) -> str:
        """Text of the link in a host's configuration."""

    @property
    def read_fds(self) -> Sequence[int]:
        """Descriptors that become readable before `read` returns something."""

    @property
    def write_fd(self) -> int | None:
        """Descriptor that becomes writable before `write` accepts more; None while no host is connected."""

    def read(self) -> bytes:
        """Return what the host has sent, b"" where nothing."""

    def write(self, data: bytes | memoryview) -> int:
        """Write what the host takes now; return how many bytes that was."""

    def hang_up(self) -> None:
        """Disconnect, as when the plug is pulled."""

    def plug_in(self) -> None:
        """Connect again under the same name."""

    def close(self) -> None: ...


class PtyLink:
    """A pseudo-terminal; `path` is a symbolic link to the side that a host opens, for as long as it is plugged in.

    Its address has a baud rate for that many bits a second, though a pseudo-terminal has none.

    Raises
    ------
    FileExistsError
        `path` is there already: a file, or a link to a terminal that is alive.
    OSError
        It cannot be made there.
    """

    def __init__(self, path: Path, bits_per_s: float = 0.0) -> None:
        self._path = path
        self._baud = max(_BAUD, math.ceil(_SPARE * bits_per_s / _BAUD) * _BAUD)
        self.read_fds: Sequence[int] = ()
        self.write_fd: int | None = None  # of the terminal's own end
        self._slave_fd = -1
        self.plug_in()

    @property
    def address(self) -> str:
        return f"serial:{self._path}?baud={self._baud}"

    def read(self) -> bytes:
        if self.write_fd is None:
            return b""
        try:
            return os.read(self.write_fd, _READ_BYTES)
        except BlockingIOError:
            return b""

    def write(self, data: bytes | memoryview) -> int:
        if self.write_fd is None:
            return 0
        try:
            return os.write(self.write_fd, data)
        except BlockingIOError:
            return 0

    def hang_up(self) -> None:
        if self.write_fd is None:
            return
        if self._path.is_symlink() and os.readlink(self._path) == os.ttyname(self._slave_fd):
            self._path.unlink()
        self._close_terminal()

    def _close_terminal(self) -> None:
        if self.write_fd is not None:
            os.close(self.write_fd)
            os.close(self._slave_fd)
        self.write_fd, self.read_fds = None, ()

    def plug_in(self) -> None:
        if self.write_fd is not None:
            return
        if self._path.exists():  # a link whose terminal is gone does not
            what = "is in use" if self._path.is_symlink() else "exists and is no symbolic link"
            raise FileExistsError(f"{self._path} {what}; remove it or name another")
        # This end keeps the slave open as well: without any holder, reading from the master fails.
        self.write_fd, self._slave_fd = os.openpty()
        self.read_fds = (self.write_fd,)
        tty.setraw(self._slave_fd)
        os.set_blocking(self.write_fd, False)
        try:
            fresh = self._path.with_name(f".{self._path.name}.{os.getpid()}")
            fresh.symlink_to(os.ttyname(self._slave_fd))
            fresh.replace(self._path)
        except OSError as error:
            self._close_terminal()
            raise type(error)(
                f"{self._path} cannot be made: {error.strerror}; name a file in a directory that is there and yours"
            ) from error

    def rename(self, name: str) -> None:
        """Change the name within the directory; a host detects it like a cable that was pulled."""
        plugged = self.write_fd is not None
        self.hang_up()
        self._path = self._path.with_name(name)
        if plugged:
            self.plug_in()

    def close(self) -> None:
        self.hang_up()


class TcpLink:
    """A listener that serves one client at a time; port 0 picks one.

    `connects` decides whether a new client is served in place of the former one, or disconnected at once.

    Raises
    ------
    ListenError
        The address is in use, or not this computer's.
    """

    def __init__(self, host: str, port: int, connects: Callable[[], bool]) -> None:
        self._host, self._port = host, port
        self._connects = connects
        self.read_fds: Sequence[int] = ()
        self.write_fd: int | None = None
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self.plug_in()

    @property
    def address(self) -> str:
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"tcp://{host}:{self._port}"

    def read(self) -> bytes:
        """Return what the client has sent, b"" if nothing; accepts new clients, and closes an ended connection."""
        data = b""
        if self._client is not None:
            try:
                data = self._client.recv(_READ_BYTES)
                if not data:
                    self._drop_client()  # the next call accepts a new client
                    return b""
            except BlockingIOError:
                pass
            except OSError:  # the connection was reset, which ends it as well
                self._drop_client()
                return b""
        if not data and (client := self._accept()) is not None:
            if self._connects():
                self._drop_client()
                self._client = client
                self._list_descriptors()
            else:
                client.close()
        return data

    def write(self, data: bytes | memoryview) -> int:
        if self._client is None:
            return 0
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._drop_client()
            return 0

    def hang_up(self) -> None:
        self._drop_client()
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            self._list_descriptors()

    def plug_in(self) -> None:
        if self._listener is None:
            family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
            try:
                self._listener = socket.create_server((self._host, self._port), family=family)
            except OSError as error:
                why = str(error.strerror or error).partition(" (while")[0]  # what Python adds
                raise ListenError(f"cannot listen on {self.address}: {why}; --tcp selects another address") from error
            self._listener.setblocking(False)
            self._port = self._listener.getsockname()[1]
            self._list_descriptors()

    def close(self) -> None:
        self.hang_up()

    def _accept(self) -> socket.socket | None:
        if self._listener is None:
            return None
        try:
            client, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return None
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return client

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
            self._list_descriptors()

    def _list_descriptors(self) -> None:
        self.read_fds = [end.fileno() for end in (self._listener, self._client) if end is not None]
        self.write_fd = None if self._client is None else self._client.fileno()
