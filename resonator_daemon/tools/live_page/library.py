"""Recordings of a page: those of its directory, by name, and those that browsers have open, each decoded once."""

import asyncio
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.tools.live_page.recorded import Recorded
from resonator_daemon.tools.live_page.requests import RefusedRequest

OPEN_MAX: Final = 4  # of all browsers together: each is decoded by a process into a temporary file
LISTED_MAX: Final = 1000

_SUFFIX: Final = ".mcap"


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
        if not names:
            return []
        files = await self._files()
        for name in names:
            if name not in files:
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
    """Return the regular files of a directory that have the suffix of recordings; links are none."""
    with os.scandir(directory) as entries:
        return {
            entry.name: entry.stat(follow_symlinks=False)
            for entry in entries
            if entry.name.endswith(_SUFFIX) and entry.is_file(follow_symlinks=False)
        }
