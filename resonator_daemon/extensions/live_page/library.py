"""Recordings of a page: those of its directory, by name, and those that browsers have open, each decoded once."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
from bisect import bisect_right
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

from mcap.writer import MCAP0_MAGIC

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.host.signals import ended_with_parent
from resonator_daemon.extensions.live_page.protocol import RefusedRequest
from resonator_daemon.mqtt.topics import TOPICS

OPEN_MAX: Final = 4  # of all browsers together: each is decoded by a process into a temporary file
LISTED_MAX: Final = 1000

_WORKER: Final = "resonator_daemon.extensions.live_page.recording_worker"
_ENDED: Final = "its decoding ended before its end; all before that is shown"
_UNREAD: Final = "its decoding ended before anything was read"
_LINE_BYTES_MAX: Final = 1 << 26  # of all marks


@dataclass
class Track:
    """Messages of one topic in order: times since the beginning, and where the payloads are."""

    times_ns: list[int] = field(default_factory=list)
    places: list[tuple[int, int]] = field(default_factory=list)  # offset and length

    def up_to(self, t_ns: int) -> int:
        """Return how many messages there are until a time, included."""
        return bisect_right(self.times_ns, t_ns)


class Recorded:
    """One recording; `run` decodes it.

    Parameters
    ----------
    path
        Of the file.
    on_change
        Called when plate, duration and marks are known, or the failure.

    Attributes
    ----------
    plate
        Name that its messages are shown under.
    truncated
        What is wrong with the file; None: nothing, or it is not known yet.
    failure
        Why nothing of the file can be shown; None: something can, or it is not known yet.
    decoded_ns
        Time since the beginning up to which messages are there.
    complete
        Whether no more messages come.
    """

    def __init__(self, path: Path, on_change: Callable[[], None]) -> None:
        self.plate = ""
        self.truncated: str | None = None
        self.failure: str | None = None
        self.decoded_ns = 0
        self.complete = False
        self.tracks = {path: Track() for path in TOPICS}
        self._path = path
        self._on_change = on_change
        self._duration_s: float | None = None
        self._marks: list[dict[str, Any]] = []
        self._file: IO[bytes] | None = None

    def describe(self) -> dict[str, Any]:
        """Return its entry in `sources` of `hello`, but for the source."""
        return {
            "file": self._path.name,
            "plate": self.plate or None,
            "duration_s": self._duration_s,
            "marks": self._marks,
            "failure": self.failure,
        }

    @property
    def end_ns(self) -> int:
        """Time of the end: of the messages that there are once all are, else of the recording."""
        return self.decoded_ns if self.complete else max(self.decoded_ns, round((self._duration_s or 0.0) * 1e9))

    def read(self, path: str, number: int) -> bytes:
        """Return the payload of a message."""
        offset, length = self.tracks[path].places[number]
        return b"" if self._file is None else os.pread(self._file.fileno(), length, offset)

    async def run(self) -> None:
        """Decode, then keep the messages until cancelled."""
        try:
            with tempfile.TemporaryFile() as self._file:
                await self._decode(self._file.fileno())
                if not self.plate and self.failure is None:
                    self._fail(_UNREAD)
                self.complete = True
                await asyncio.get_running_loop().create_future()
        except OSError as error:  # descriptors, memory or the disk
            self._fail(meaning_of(error))

    def _fail(self, failure: str) -> None:
        self.failure = failure
        self.complete = True
        self._on_change()

    async def _decode(self, number: int) -> None:
        entries = asyncio.StreamReader(_LINE_BYTES_MAX)
        with self._start(number) as process:
            try:
                transport, _ = await asyncio.get_running_loop().connect_read_pipe(
                    lambda: asyncio.StreamReaderProtocol(entries), process.stdout
                )
                try:
                    await self._receive(entries)
                finally:
                    transport.close()
            finally:
                process.kill()

    def _start(self, number: int) -> subprocess.Popen[bytes]:
        """Start the process; unlike with asyncio, its end can be awaited after this task is cancelled."""
        return subprocess.Popen(
            (sys.executable, "-P", "-m", _WORKER, str(self._path), str(number)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            pass_fds=(number,),
            start_new_session=True,  # Ctrl-C is for the server
            preexec_fn=ended_with_parent(signal.SIGKILL),
        )

    async def _receive(self, stream: asyncio.StreamReader) -> None:
        """Read what `recording_worker` writes; a line that is cut off ends it."""
        with suppress(ValueError):
            async for line in stream:
                match json.loads(line):
                    case [path, t_ns, offset, length]:
                        track = self.tracks[path]
                        track.times_ns.append(t_ns)
                        track.places.append((offset, length))
                    case [t_ns]:
                        self.decoded_ns = t_ns
                    case {"plate": plate, "duration_s": duration_s, "marks": marks, "truncated": cut}:
                        self.plate, self._duration_s, self._marks, self.truncated = plate, duration_s, marks, cut
                        self._on_change()
                    case {"failure": failure}:
                        self._fail(failure)
                        return
                    case {"truncated": cut}:
                        self.truncated = cut or self.truncated
                        return
        self.truncated = self.truncated or _ENDED


@dataclass
class _Use:
    recorded: Recorded
    task: asyncio.Task[None]
    count: int = 0


class Library:
    """Recordings that browsers may open: no path outside the directory is read.

    Parameters
    ----------
    directory
        Whose recordings are listed; None: none are.
    on_change
        Called when plate, duration, marks or failure of an open recording are known.
    """

    def __init__(self, directory: Path | None, on_change: Callable[[], None]) -> None:
        self._directory = directory
        self._on_change = on_change
        self._uses: dict[Path, _Use] = {}
        self._ending: set[asyncio.Task[None]] = set()  # each until its process has ended

    @property
    def name(self) -> str | None:
        """Name of the directory."""
        return None if self._directory is None else self._directory.resolve().name

    async def listing(self) -> dict[str, Any]:
        """Return name, size and time of the recordings in the directory, newest first, and how many are omitted.

        Raises
        ------
        RefusedRequest
            There is no directory, or it cannot be read.
        """
        found = sorted((await self._files()).items(), key=lambda item: (-item[1].st_mtime, item[0]))
        listed = [{"name": name, "bytes": its.st_size, "modified_s": its.st_mtime} for name, its in found[:LISTED_MAX]]
        return {"recordings": listed, "omitted": len(found) - len(listed)}

    async def find(self, names: Sequence[str]) -> list[Path]:
        """Return the files of names in the directory.

        Raises
        ------
        RefusedRequest
            There is none of a name.
        """
        for name in set(names).difference(await self._files() if names else ()):
            raise RefusedRequest("unknown_recording", f"{name!r} is no recording of this directory any more")
        return [Path(self._directory or "", name) for name in names]

    def exchange(self, before: Sequence[Path], after: Sequence[Path]) -> list[Recorded]:
        """Return recordings that are used from now on, instead of others.

        Raises
        ------
        RefusedRequest
            Too many would be open; nothing was exchanged.
        """
        kept = {path for path, use in self._uses.items() if use.count > before.count(path)}
        if len(kept.union(after)) > OPEN_MAX:
            raise RefusedRequest(
                "too_many_recordings", f"{OPEN_MAX} recordings are open; close one, or wait until another browser does"
            )
        for path in after:
            if path not in self._uses:
                recorded = Recorded(path, self._on_change)
                self._uses[path] = _Use(recorded, asyncio.create_task(recorded.run()))
            self._uses[path].count += 1
        for path in before:
            self._uses[path].count -= 1
            if not self._uses[path].count:
                self._end(self._uses.pop(path).task)
        return [self._uses[path].recorded for path in after]

    async def close(self) -> None:
        """End the decoding of all recordings."""
        for use in self._uses.values():
            self._end(use.task)
        self._uses.clear()
        await asyncio.gather(*self._ending, return_exceptions=True)

    def _end(self, task: asyncio.Task[None]) -> None:
        task.cancel()
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)

    async def _files(self) -> dict[str, os.stat_result]:
        if self._directory is None:
            raise RefusedRequest("no_directory", "this page lists no recordings; `resonatord view DIRECTORY` does")
        try:
            return await asyncio.to_thread(_recordings, self._directory)
        except OSError as error:
            raise RefusedRequest("directory_unreadable", f"{self.name}: {meaning_of(error)}") from None


def _recordings(directory: Path) -> dict[str, os.stat_result]:
    """Return the regular files of a directory that have suffix and first bytes of a recording; links are none."""
    with os.scandir(directory) as entries:
        return {
            entry.name: entry.stat(follow_symlinks=False)
            for entry in entries
            if entry.name.endswith(".mcap") and entry.is_file(follow_symlinks=False) and _is_mcap(entry.path)
        }


def _is_mcap(path: str) -> bool:
    with suppress(OSError), open(path, "rb") as file:
        return file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
    return False
