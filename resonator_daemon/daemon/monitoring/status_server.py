"""Serves the status of the daemon to programs on the same computer: one JSON object per connection to a Unix socket."""

import asyncio
import contextlib
import fcntl
import logging
import os
import socket
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from resonator_daemon.base.errors import ExitCode, UserError, reason_of
from resonator_daemon.base.host.files import make_private
from resonator_daemon.daemon.monitoring.status import Status
from resonator_daemon.mqtt.codec import encode

SOCKET_NAME: Final = "status.sock"
PATH_BYTES_MAX: Final = 107  # sun_path of sockaddr_un has room for so many and a zero
_MODE: Final = 0o660
_BACKLOG: Final = 128
_TOGETHER: Final = 25  # connections, then a pause: 500 a second at most, about a tenth of a core
_FRESH_S: Final = 0.1  # those who ask within it get the same answer
_CONFIG_BYTES_MAX: Final = 4096  # PATH_MAX

log = logging.getLogger(__name__)


class StatusTimes(NamedTuple):
    """Time limits and pauses of a status server, in seconds."""

    retry_s: float = 5.0  # after a failure
    check_s: float = 5.0  # for which a removed socket may go unnoticed
    send_s: float = 1.0  # an answer of usual size goes into the socket's buffer at once, read or not
    pause_s: float = 0.05


class AlreadyRunningError(UserError):
    """Another process runs with the same configuration file."""

    exit_code = ExitCode.FAILED  # which a service manager starts again: the other one may end
    code = "already_running"


class StatusServer:
    """Answers on a socket as long as `run` does; each failure is logged once and retried.

    Parameters
    ----------
    path
        Of the socket. A file next to it, `status.lock`, is locked meanwhile and stays.
    config
        Path of the daemon's configuration file, written to the lock for another daemon that finds it locked.
    make
        Makes the answer; called on the event loop's thread, at most ten times a second.
    times

    Attributes
    ----------
    may_begin
        Set once no other daemon holds the lock with the same configuration file, or the lock cannot be used.
    """

    def __init__(self, path: Path, config: Path, make: Callable[[], Status], times: StatusTimes | None = None) -> None:
        self._times = times or StatusTimes()
        self._path = path
        self._config = os.fsencode(config.resolve())
        self._make = make
        self._made = b""
        self._made_s = -_FRESH_S
        self._problem: str | None = None
        self.may_begin = asyncio.Event()

    async def run(self) -> None:
        """Answer until cancelled.

        Raises
        ------
        AlreadyRunningError
            At the start, another daemon runs with the same configuration file.
        """
        while True:
            try:
                with self._listening() as listening:
                    self.may_begin.set()
                    await self._serve(listening)
                log.warning("%s or its lock was removed or replaced: made again", self._path)
            except (OSError, AlreadyRunningError) as error:
                if isinstance(error, AlreadyRunningError) and not self.may_begin.is_set():
                    raise
                self.may_begin.set()
                reason = reason_of(error) if isinstance(error, OSError) else str(error)
                self._log_change(f"`resonatord status` does not find this daemon: {reason}")
                await asyncio.sleep(self._times.retry_s)

    async def _serve(self, listening: "_Listening") -> None:
        """Answer until the socket is no longer under its path, or another daemon could replace it."""
        # Not asyncio's server: without free descriptors it logs a hundred errors a second.
        loop = asyncio.get_running_loop()
        answered = 0
        while True:
            if not await _connecting(listening.own, self._times.check_s):
                if not listening.in_place():
                    return
                continue
            try:
                client, _ = listening.own.accept()
            except BlockingIOError:  # it has left already
                continue
            client.setblocking(False)
            with client:
                self._log_change(None)
                with contextlib.suppress(OSError):  # TimeoutError is one: a client that does not read is left
                    async with asyncio.timeout(self._times.send_s):
                        await loop.sock_sendall(client, self._fresh_answer(loop.time()))
            answered += 1
            await asyncio.sleep(self._times.pause_s if answered % _TOGETHER == 0 else 0)

    def _fresh_answer(self, now_s: float) -> bytes:
        if now_s - self._made_s >= _FRESH_S:
            self._made, self._made_s = encode(self._make()) + b"\n", now_s
        return self._made

    @contextlib.contextmanager
    def _listening(self) -> Iterator["_Listening"]:
        length_bytes = len(os.fsencode(self._path))
        if length_bytes > PATH_BYTES_MAX:
            raise OSError(
                f"the path of its socket, {self._path}, has {length_bytes} bytes, and sockets take {PATH_BYTES_MAX} "
                "at most; give the configuration file a shorter name, or set XDG_RUNTIME_DIR to a shorter path"
            )
        make_private(self._path.parent)
        with (
            _exclusive_lock(self._path, self._config) as lock,
            socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening,
        ):
            _remove_socket(self._path)  # left by a daemon that was killed: ours is the lock
            listening.setblocking(False)
            listening.bind(os.fspath(self._path))
            made = _Listening(listening, {path: _identity(path) for path in (self._path, lock)})
            try:
                self._path.chmod(_MODE)
                listening.listen(_BACKLOG)
                yield made
            finally:
                if made.in_place():
                    with contextlib.suppress(OSError):
                        self._path.unlink()

    def _log_change(self, problem: str | None) -> None:
        if problem is not None and problem != self._problem:
            log.warning("%s", problem)
        elif problem is None and self._problem is not None:
            log.info("`resonatord status` sees this daemon")
        self._problem = problem


class _Listening(NamedTuple):
    """A socket that listens, with the files that others find it by."""

    own: socket.socket
    files: dict[Path, tuple[int, int] | None]

    def in_place(self) -> bool:
        return all(_identity(path) == made for path, made in self.files.items())


async def _connecting(listening: socket.socket, limit_s: float) -> bool:
    """Return whether a client connects within a time; a limit on `sock_accept` would lose one that comes at its end."""
    loop = asyncio.get_running_loop()
    connecting: asyncio.Future[None] = loop.create_future()

    def connects() -> None:
        if not connecting.done():
            connecting.set_result(None)

    loop.add_reader(listening, connects)
    try:
        return bool((await asyncio.wait([connecting], timeout=limit_s))[0])
    finally:
        loop.remove_reader(listening)


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


@contextlib.contextmanager
def _exclusive_lock(path: Path, config: bytes) -> Iterator[Path]:
    """Hold the lock next to the socket and yield its path; raises if another process holds it."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    lock = os.open(path.with_suffix(".lock"), flags, 0o600)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            others = os.pread(lock, _CONFIG_BYTES_MAX, 0)
            if others == config:
                what = "runs with this configuration file already; stop it, or use a configuration of its own"
                raise AlreadyRunningError(f"{_holder(lock)} {what}") from None
            named = f" ({os.fsdecode(others)})" if others else ""
            what = f"runs with a configuration file of the same name{named}; rename one of both files"
            raise OSError(f"{_holder(lock)}, which answers on {path}, {what}") from None
        os.ftruncate(lock, 0)
        os.pwrite(lock, config, 0)
        yield path.with_suffix(".lock")
    finally:
        os.close(lock)


def _holder(lock: int) -> str:
    """Return the name of the process that holds a lock, unknown if it is in another container."""
    end = f":{os.fstat(lock).st_ino}"
    with contextlib.suppress(OSError):
        for line in Path("/proc/locks").read_text().splitlines():  # 1: FLOCK ADVISORY WRITE PID MAJOR:MINOR:INODE 0 EOF
            fields = line.split()
            if fields[1] == "FLOCK" and fields[5].endswith(end):
                return f"process {fields[4]}"
    return "another process"


def _remove_socket(path: Path) -> None:
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise FileExistsError(f"{path} is in the way and no socket; remove it")
        path.unlink()
