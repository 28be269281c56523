"""Linux's inotify: what appears or changes in a directory.

Three calls of the C library and one record. The packages that wrap them look for the library by running `ldconfig`,
which a daemon in a sandbox may not, or bring an event loop.
"""

import ctypes
import os
import struct
from contextlib import suppress
from typing import NamedTuple

_EVENT = struct.Struct("@iIII")
_ATTRIB, _MOVED_TO, _CREATE, _DELETE_SELF, _MOVE_SELF = 0x4, 0x80, 0x100, 0x400, 0x800
_ONLYDIR = 0x01000000
_OVERFLOW = 0x4000
_READ_BYTES = 1 << 16

_libc = ctypes.CDLL(None, use_errno=True)


class DirectoryEvent(NamedTuple):
    """Something appeared in `directory`, or what it is called there changed; an empty name is the directory itself."""

    directory: str
    name: str


class DirectoryEvents:
    """Watches directories, not what is in their subdirectories.

    Raises
    ------
    OSError
        The system gives no more of it: /proc/sys/fs/inotify/max_user_instances.
    """

    def __init__(self) -> None:
        self._descriptor = _checked(_libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))
        self._directories: dict[int, str] = {}

    def fileno(self) -> int:
        return self._descriptor

    def watch(self, directories: set[str]) -> None:
        """Watch these from now on, and no others; one that cannot be watched is left out."""
        for watch, directory in list(self._directories.items()):
            if directory not in directories:
                _libc.inotify_rm_watch(self._descriptor, watch)
                del self._directories[watch]
        for directory in directories - set(self._directories.values()):
            mask = _ATTRIB | _MOVED_TO | _CREATE | _DELETE_SELF | _MOVE_SELF | _ONLYDIR
            with suppress(OSError):  # gone again, or not ours to read
                added = _libc.inotify_add_watch(self._descriptor, os.fsencode(directory), mask)
                self._directories[_checked(added)] = directory

    def read(self) -> list[DirectoryEvent]:
        """Return what has happened since the last call, without waiting."""
        data = b""
        with suppress(BlockingIOError):
            while True:
                data += os.read(self._descriptor, _READ_BYTES)
        found = []
        position = 0
        while position < len(data):
            watch, mask, _, size = _EVENT.unpack_from(data, position)
            position += _EVENT.size + size
            name = os.fsdecode(data[position - size : position].rstrip(b"\0"))
            if mask & _OVERFLOW:  # anything may have happened anywhere
                found += [DirectoryEvent(directory, "") for directory in self._directories.values()]
            elif watch in self._directories:
                directory = self._directories[watch]
                if mask & (_DELETE_SELF | _MOVE_SELF):
                    del self._directories[watch]  # its place may be taken by another, to be watched again
                    _libc.inotify_rm_watch(self._descriptor, watch)
                found.append(DirectoryEvent(directory, name))
        return found

    def close(self) -> None:
        os.close(self._descriptor)


def _checked(result: int) -> int:
    if result < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return result
