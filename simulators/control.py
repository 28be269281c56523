"""Control socket of an emulator: a local Unix socket on which clients press the plate, a JSON object a line."""

import json
import os
import socket
import stat
from collections.abc import Collection
from itertools import count
from pathlib import Path
from typing import Any

from simulators.presses import Presses

CLIENTS_MAX = 8
LINE_BYTES_MAX = 4096

_READ_BYTES = 8192  # at once: the board waits while they are applied
_UNREAD_BYTES_MAX = 1 << 20  # of answers that a client does not read, before it is disconnected


class ControlSocket:
    """Listener at `path`, for the user of the emulator alone; nothing here ever blocks.

    A client that disconnects releases its touches. One that does not read its answers is disconnected.

    Raises
    ------
    FileExistsError
        `path` is there already: a file, or a socket that somebody listens on.
    OSError
        It cannot be made there.
    """

    def __init__(self, path: Path, presses: Presses) -> None:
        self._path = path
        self._presses = presses
        self._clients: dict[int, _Client] = {}  # by descriptor
        self._numbers = count()
        self._listener = _listener(path)

    @property
    def read_fds(self) -> list[int]:
        """Descriptors that become readable when there is something to serve."""
        return [self._listener.fileno(), *self._clients]

    @property
    def write_fds(self) -> list[int]:
        """Descriptors that become writable when a client accepts more answers."""
        return [fd for fd, client in self._clients.items() if client.unsent]

    def serve(self, ready: Collection[int]) -> None:
        """Apply the requests of those descriptors that are ready, and answer them."""
        if self._listener.fileno() in ready:
            self._accept()
        for fd in [fd for fd in self._clients if fd in ready]:
            client = self._clients[fd]
            if not (client.read(self._presses) and client.write()):
                self._disconnect(fd)

    def close(self) -> None:
        for fd in list(self._clients):
            self._disconnect(fd)
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        connection.setblocking(False)
        client = _Client(connection, next(self._numbers))
        if len(self._clients) < CLIENTS_MAX:
            self._clients[connection.fileno()] = client
            return
        client.answer(_refusal("too_many_clients", f"{CLIENTS_MAX} clients are connected; close one"))
        client.write()
        connection.close()

    def _disconnect(self, fd: int) -> None:
        client = self._clients.pop(fd)
        self._presses.release_all(client.number)
        client.connection.close()


class _Client:
    """A connection: what has come of a line, and answers that wait."""

    def __init__(self, connection: socket.socket, number: int) -> None:
        self.connection = connection
        self.number = number
        self.unsent = bytearray()
        self._received = b""
        self._skips = False  # the rest of a line that was too long

    def read(self, presses: Presses) -> bool:
        """Apply the lines that have come; return whether the client is still there."""
        try:
            data = self.connection.recv(_READ_BYTES)
        except BlockingIOError:
            return True
        except OSError:
            return False
        *lines, self._received = (self._received + data).split(b"\n")
        for line in lines:
            if self._skips:
                self._skips = False
            elif len(line) > LINE_BYTES_MAX:
                self._refuse_length()
            elif line.strip():
                self.answer(presses.request(self.number, line))
        if len(self._received) > LINE_BYTES_MAX:
            if not self._skips:
                self._refuse_length()
            self._received, self._skips = b"", True
        return bool(data)

    def answer(self, content: dict[str, Any]) -> None:
        self.unsent += json.dumps(content).encode() + b"\n"

    def write(self) -> bool:
        """Write what the client accepts now; return whether it is still there, and reads."""
        try:
            while self.unsent:
                del self.unsent[: self.connection.send(self.unsent)]
        except BlockingIOError:
            return len(self.unsent) <= _UNREAD_BYTES_MAX
        except OSError:
            return False
        return True

    def _refuse_length(self) -> None:
        self.answer(_refusal("line_too_long", f"a line has at most {LINE_BYTES_MAX} bytes"))


def _refusal(code: str, message: str) -> dict[str, Any]:
    return {"ok": False, "error": {"code": code, "message": message}}


def _listener(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        _clear(path)
        listener.setblocking(False)
        listener.bind(os.fspath(path))
        path.chmod(0o600)  # before anybody can connect
        listener.listen(CLIENTS_MAX)
    except OSError as error:
        listener.close()
        why = error.strerror or str(error)  # a path that is too long has no number
        raise type(error)(f"the control socket cannot be made at {path}: {why}; name another place") from error
    return listener


def _clear(path: Path) -> None:
    """Remove the socket that an emulator left behind when it was killed."""
    if not path.exists():
        return
    if stat.S_ISSOCK(path.stat().st_mode):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            try:
                probe.connect(os.fspath(path))
            except ConnectionRefusedError:
                path.unlink()
                return
    raise FileExistsError(17, "exists already")
