"""Connection of a daemon with its decoder process: arrays in shared memory, all else pickled on a socket."""

import errno
import mmap
import os
import pickle
import select
import socket
import struct
from typing import Any, Final, Self

from resonator_daemon.measure.sensors.surface_requests import SurfaceSettings

_MESSAGE_BYTES_MAX: Final = 1 << 17  # without its arrays; the kernel sends as much in one piece
_SITE_BYTES: Final = 64  # of each direction: a frame has 48 for each site, a map 36, settings up to 40
_OTHER_BYTES: Final = 1 << 16
_ARRAY_BYTES: Final = struct.Struct("<I")


class DecoderConnection:
    """One end of the connection.

    The memory has no name, so nothing is left of it when both processes have ended. A direction has room for the arrays
    of one message: the next message with arrays may be sent when the other end has answered.

    Parameters
    ----------
    own_socket
        Keeps the boundaries of messages.
    memory_fd
        Of the shared memory; closed by this class.
    is_daemon
        Whether this is the daemon's end.
    """

    def __init__(self, own_socket: socket.socket, memory_fd: int, *, is_daemon: bool) -> None:
        self.socket = own_socket
        size = os.fstat(memory_fd).st_size
        try:
            self._memory = memoryview(mmap.mmap(memory_fd, size))
        finally:
            os.close(memory_fd)
        self._to_other = 0 if is_daemon else size // 2  # where arrays are written
        self._from_other = size // 2 - self._to_other
        self._half = size // 2
        self._buffer = bytearray(_MESSAGE_BYTES_MAX)

    @classmethod
    def pair(cls, settings: SurfaceSettings) -> tuple[Self, tuple[socket.socket, int]]:
        """Return the daemon's end for a skin, and what the other end is made of."""
        own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        own.setblocking(False)
        memory_fd = os.memfd_create("resonatord-decoder")
        try:
            os.ftruncate(memory_fd, 2 * (_SITE_BYTES * len(settings.site_ids) + _OTHER_BYTES))
            return cls(own, os.dup(memory_fd), is_daemon=True), (other, memory_fd)
        except OSError:
            os.close(memory_fd)
            raise

    def send(self, message: Any) -> None:
        """Send a message; OSError if the other end is gone, or the message is too large."""
        arrays: list[pickle.PickleBuffer] = []
        content = pickle.dumps(message, protocol=5, buffer_callback=arrays.append)
        sizes, at, end = b"", self._to_other, self._to_other + self._half
        for array in arrays:
            flat = array.raw()
            sizes += _ARRAY_BYTES.pack(flat.nbytes)
            if at + flat.nbytes > end:
                raise OSError(errno.EMSGSIZE, f"arrays of more than {self._half} bytes")
            self._memory[at : at + flat.nbytes] = flat
            at += flat.nbytes
        whole = bytes((len(arrays),)) + sizes + content
        if len(whole) > _MESSAGE_BYTES_MAX:
            raise OSError(errno.EMSGSIZE, f"a message of {len(whole)} bytes without its arrays")
        self.socket.send(whole)

    def receive(self) -> Any:
        """Return the next message, with a read-only copy of its arrays; EOFError if the other end is gone."""
        length = self.socket.recv_into(self._buffer)
        if not length:
            raise EOFError
        count, at, arrays = self._buffer[0], self._from_other, list[bytes]()
        for number in range(count):
            (size,) = _ARRAY_BYTES.unpack_from(self._buffer, 1 + _ARRAY_BYTES.size * number)
            arrays.append(bytes(self._memory[at : at + size]))
            at += size
        return pickle.loads(memoryview(self._buffer)[1 + _ARRAY_BYTES.size * count : length], buffers=arrays)

    @property
    def has_message(self) -> bool:
        """Whether `receive` would return at once."""
        return bool(select.select((self.socket,), (), (), 0.0)[0])
