"""Connection of a daemon with its decoder process: arrays in shared memory, all else pickled on a socket."""

import mmap
import os
import pickle
import select
import socket
import struct
from typing import Any, Final, Self

from resonator_daemon.measure.sensors.surface_requests import SurfaceSettings

_NOTICE_BYTES_MAX: Final = 1 << 17  # the kernel sends as much in one piece
_SITE_BYTES: Final = 64  # of each direction: a frame has 48 for each site, a map 36, settings up to 40
_OTHER_BYTES: Final = 1 << 16
_HEAD: Final = struct.Struct("<I")  # size of one array


class Channel:
    """One end of the connection.

    The memory has no name, so nothing is left of it when both processes have ended. A direction has room for the arrays
    of one message: the next message with arrays may be sent when the other end has answered.

    Parameters
    ----------
    connection
        Keeps the boundaries of messages.
    memory_fd
        Of the shared memory; closed by this class.
    is_daemon
        Which end this is.
    """

    def __init__(self, connection: socket.socket, memory_fd: int, *, is_daemon: bool) -> None:
        self.connection = connection
        size = os.fstat(memory_fd).st_size
        self._memory = memoryview(mmap.mmap(memory_fd, size))
        os.close(memory_fd)
        self._to_other = 0 if is_daemon else size // 2  # where arrays are written
        self._from_other = size // 2 - self._to_other
        self._notice = bytearray(_NOTICE_BYTES_MAX)

    @classmethod
    def pair(cls, settings: SurfaceSettings) -> tuple[Self, tuple[socket.socket, int]]:
        """Return the daemon's end for a skin, and what the other end is made of."""
        own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        own.setblocking(False)
        memory_fd = os.memfd_create("resonatord-decoder")
        os.ftruncate(memory_fd, 2 * (_SITE_BYTES * len(settings.site_ids) + _OTHER_BYTES))
        return cls(own, os.dup(memory_fd), is_daemon=True), (other, memory_fd)

    def send(self, message: Any) -> None:
        """Send a message; OSError if the other end is gone."""
        arrays: list[pickle.PickleBuffer] = []
        content = pickle.dumps(message, protocol=5, buffer_callback=arrays.append)
        sizes, at = b"", self._to_other
        for array in arrays:
            flat = array.raw()
            sizes += _HEAD.pack(flat.nbytes)
            self._memory[at : at + flat.nbytes] = flat
            at += flat.nbytes
        self.connection.send(bytes((len(arrays),)) + sizes + content)

    def receive(self) -> Any:
        """Return the next message, with a read-only copy of its arrays; EOFError if the other end is gone."""
        length = self.connection.recv_into(self._notice)
        if not length:
            raise EOFError
        count, at, arrays = self._notice[0], self._from_other, list[bytes]()
        for number in range(count):
            (size,) = _HEAD.unpack_from(self._notice, 1 + _HEAD.size * number)
            arrays.append(bytes(self._memory[at : at + size]))
            at += size
        return pickle.loads(memoryview(self._notice)[1 + _HEAD.size * count : length], buffers=arrays)

    @property
    def has_message(self) -> bool:
        """Whether `receive` would return at once."""
        return bool(select.select((self.connection,), (), (), 0.0)[0])
