"""A recording that is shown: its messages, decoded ahead by another process, by topic and time."""

import asyncio
import json
import os
import signal
import sys
import tempfile
from asyncio.subprocess import DEVNULL, PIPE
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from resonator_daemon.host.parent_death import ended_with_parent
from resonator_daemon.live_page.recording_entries import DONE, ENTRY, PATHS, SCANNED, TIME

_WORKER: Final = "resonator_daemon.live_page.recording_worker"
_FAILED: Final = "its decoding ended before its end; all before that is shown"


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
    source
        `a` or `b`.
    path
        Of the file.
    on_scanned
        Called when plate, duration and marks are known.

    Attributes
    ----------
    plate
        Name that its messages are shown under.
    truncated
        What is wrong with the file; None: nothing, or it is not known yet.
    decoded_ns
        Time since the beginning up to which messages are there.
    complete
        Whether no more messages come.
    """

    def __init__(self, source: str, path: Path, on_scanned: Callable[[], None]) -> None:
        self.source = source
        self.plate = ""
        self.truncated: str | None = None
        self.decoded_ns = 0
        self.complete = False
        self.tracks = {path: Track() for path in PATHS}
        self._path = path
        self._on_scanned = on_scanned
        self._duration_s: float | None = None
        self._marks: list[dict[str, Any]] = []
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - `run` closes it

    def describe(self) -> dict[str, Any]:
        """Return its entry in `sources` of `hello`."""
        return {
            "source": self.source,
            "file": self._path.name,
            "plate": self.plate or None,
            "duration_s": self._duration_s,
            "marks": self._marks,
        }

    @property
    def end_ns(self) -> int:
        """Time of the end: of the messages that there are once all are, else of the recording."""
        return self.decoded_ns if self.complete else max(self.decoded_ns, round((self._duration_s or 0.0) * 1e9))

    def read(self, path: str, number: int) -> bytes:
        """Return the payload of a message."""
        offset, length = self.tracks[path].places[number]
        return os.pread(self._file.fileno(), length, offset)

    async def run(self) -> None:
        """Decode, then keep the messages until cancelled."""
        number = self._file.fileno()
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", _WORKER, str(self._path), str(number)),
            stdin=DEVNULL,
            stdout=PIPE,
            pass_fds=(number,),
            start_new_session=True,  # Ctrl-C is for the server
            preexec_fn=ended_with_parent(signal.SIGKILL),
        )
        try:
            if process.stdout is not None:
                await self._receive(process.stdout)
            self.complete = True
            await asyncio.get_running_loop().create_future()
        finally:
            if process.returncode is None:
                process.kill()
            await process.wait()
            self._file.close()

    async def _receive(self, stream: asyncio.StreamReader) -> None:
        try:
            while True:
                kind, t_ns, offset, length = ENTRY.unpack(await stream.readexactly(ENTRY.size))
                if kind < len(PATHS):
                    track = self.tracks[PATHS[kind]]
                    track.times_ns.append(t_ns)
                    track.places.append((offset, length))
                elif kind == TIME:
                    self.decoded_ns = t_ns
                else:
                    content = json.loads(await stream.readexactly(length))
                    if content["truncated"] is not None:
                        self.truncated = content["truncated"]
                    if kind == DONE:
                        return
                    if kind == SCANNED:
                        self.plate, self._duration_s = content["plate"], content["duration_s"]
                        self._marks = content["marks"]
                        self._on_scanned()
        except asyncio.IncompleteReadError:
            self.truncated = self.truncated or _FAILED
