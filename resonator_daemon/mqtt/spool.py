"""The file of events, which outlives the process: those that wait, and those of the last days.

Each batch is one transaction with a write-ahead log, not flushed to the medium (SQLite's `synchronous=NORMAL`): what
was written survives the end of the process, in whatever way. What was written before `sync` survives a power failure,
too, and the file stays in order.
"""

import contextlib
import os
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

from resonator_daemon.base.errors import meaning_of, reason_of
from resonator_daemon.base.host.files import make_directory

EVENTS_MAX: Final = 100_000
BYTES_MAX: Final = 64 * 2**20  # of payloads

FILE: Final = "events.sqlite3"
_FORMAT: Final = 1
_SET_FORMAT: Final = f"PRAGMA user_version={_FORMAT}"
_FULL: Final = sqlite3.SQLITE_FULL
_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_IN_USE: Final = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
_CREATE: Final = (
    """CREATE TABLE IF NOT EXISTS events (
        run INTEGER, number INTEGER, topic TEXT NOT NULL, payload BLOB NOT NULL, PRIMARY KEY (run, number)
    )""",
    # Of `event_history`.
    "CREATE TABLE IF NOT EXISTS runs (id INTEGER PRIMARY KEY, boot TEXT NOT NULL UNIQUE, newest_seq INTEGER NOT NULL)",
    """CREATE TABLE IF NOT EXISTS history (
        id INTEGER PRIMARY KEY, boot TEXT NOT NULL, seq INTEGER NOT NULL, stored_ns INTEGER NOT NULL,
        payload BLOB NOT NULL, UNIQUE (boot, seq)
    )""",
)
_COPIED: Final = {  # columns by table; numbers of rows are the file's own
    "events": "run, number, topic, payload",
    "runs": "boot, newest_seq",
    "history": "boot, seq, stored_ns, payload",
}
_SIZES: Final = "SELECT count(*), coalesce(sum(length(payload)), 0) FROM events"
_OLDEST_BEYOND: Final = """FROM events WHERE (run, number) > (?, ?) AND NOT (run = ? AND number <= ?)
    ORDER BY run, number LIMIT ?"""

Key = tuple[int, int]  # run of the daemon, number of the event in it: the order in which they are sent
ResultT = TypeVar("ResultT")


class SpoolError(Exception):
    """A disk operation failed; nothing was changed."""


class SpoolDamagedError(SpoolError):
    """What was on disk cannot be read any more; it was set aside, and the next call begins again."""


class SpooledEvent(NamedTuple):
    """An event as it is sent, with its place in the order."""

    key: Key
    topic: str
    payload: bytes


class Progress(NamedTuple):
    """What has left the spool for memory: everything up to `read`, and of one run all up to `passed`."""

    read: Key
    passed: Key


class Spool:
    """A queue of events in a file of its own, which one process holds; calls take as long as the disk does.

    `transact` gives `EventHistory` the same file.

    To be used by one thread at a time. Every method but `close` raises SpoolError where directory or disk refuse or
    another process holds the spool, and SpoolDamagedError.

    Parameters
    ----------
    directory
        Made when it is missing.

    Attributes
    ----------
    unsynced : bool
        Something was written since the last `sync`.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / FILE
        self._database: sqlite3.Connection | None = None
        self._file: tuple[int, int] | None = None  # device and inode of the open database
        self._run: int | None = None
        self._count = self._bytes = 0
        self.unsynced = False

    def open(self) -> tuple[int, int]:
        """Return the number of this run, and how many events are on disk."""
        return self.transact(lambda _: (self._run or 0, self._count))

    def make_again(self) -> bool:
        """Where the open file is not the one of its name any more, write all of it to a new one; True: it was done.

        SpoolError leaves the open one in use: what is in it can be read and sent as long as the process lives.
        """
        removed = self._database
        if removed is None or self._identity() == self._file:
            return False
        before = self._file, self._count, self._bytes
        self._database = None
        try:
            self.transact(lambda database: self._copy(removed, database))
        except SpoolError as error:
            self.close()
            self._database = removed
            self._file, self._count, self._bytes = before
            raise SpoolError(f"{self.path} was removed or replaced, and {error}") from error
        removed.close()
        return True

    def append(self, events: Sequence[SpooledEvent], progress: Progress, removable: int) -> int:
        """Write events; return how many of the oldest beyond `progress`, at most `removable`, had to go for them."""

        def append(database: sqlite3.Connection) -> int:
            new_bytes = sum(len(event.payload) for event in events)
            over_count = self._count + len(events) - EVENTS_MAX
            over_bytes = self._bytes + new_bytes - BYTES_MAX
            gone: list[Key] = []
            if over_count > 0 or over_bytes > 0:
                rows = database.execute(
                    f"SELECT run, number, length(payload) {_OLDEST_BEYOND}",
                    (*progress.read, *progress.passed, removable),
                )
                for run, number, length in rows:
                    if len(gone) >= over_count and over_bytes <= 0:
                        break
                    gone.append((run, number))
                    over_bytes -= length
            self._delete(database, gone)
            database.executemany(
                "INSERT INTO events VALUES (?, ?, ?, ?)",
                [(*event.key, event.topic, event.payload) for event in events],
            )
            self._count += len(events)
            self._bytes += new_bytes
            return len(gone)

        return self.transact(append)

    def read(self, progress: Progress, count: int) -> list[SpooledEvent]:
        """Return the oldest events beyond `progress`; they stay on disk."""

        def read(database: sqlite3.Connection) -> list[SpooledEvent]:
            rows = database.execute(
                f"SELECT run, number, topic, payload {_OLDEST_BEYOND}", (*progress.read, *progress.passed, count)
            )
            return [SpooledEvent((run, number), topic, payload) for run, number, topic, payload in rows]

        return self.transact(read)

    def delete(self, keys: Sequence[Key]) -> None:
        self.transact(lambda database: self._delete(database, keys))

    def sync(self) -> None:
        """Wait until the medium has all that was written."""
        self.transact(lambda database: database.execute(_SET_FORMAT), durable=True)

    def close(self) -> None:
        """Close the file."""
        database, self._database = self._database, None
        if database is not None:
            with contextlib.suppress(sqlite3.Error):
                database.close()

    def _identity(self) -> tuple[int, int] | None:
        try:
            status = os.stat(self.path)
        except OSError:
            return None
        return status.st_dev, status.st_ino

    def _copy(self, source: sqlite3.Connection, target: sqlite3.Connection) -> None:
        for table, columns in _COPIED.items():
            places = ", ".join("?" * len(columns.split(", ")))
            rows = source.execute(f"SELECT {columns} FROM {table} ORDER BY rowid")
            target.executemany(f"INSERT OR REPLACE INTO {table} ({columns}) VALUES ({places})", rows)
        self._count, self._bytes = target.execute(_SIZES).fetchone()

    def _delete(self, database: sqlite3.Connection, keys: Sequence[Key]) -> None:
        for key in keys:
            row = database.execute("SELECT length(payload) FROM events WHERE run = ? AND number = ?", key).fetchone()
            if row is not None:
                database.execute("DELETE FROM events WHERE run = ? AND number = ?", key)
                self._count -= 1
                self._bytes -= row[0]

    def transact(self, transact: Callable[[sqlite3.Connection], ResultT], *, durable: bool = False) -> ResultT:
        """Carry out one transaction and return its result, on a database that is opened for it where it is not open.

        A durable one that writes flushes the log with all earlier ones to the medium.
        """
        before = None
        try:
            database = self._database or self._open()
            database.execute(f"PRAGMA synchronous={'FULL' if durable else 'NORMAL'}")
            before = self._count, self._bytes
            database.execute("BEGIN IMMEDIATE")
            changes_before = database.total_changes
            result = transact(database)
            database.execute("COMMIT")
            self.unsynced = not durable and (self.unsynced or database.total_changes > changes_before)
        except sqlite3.Error as error:
            if before is not None:
                self._count, self._bytes = before
            raise self._failed(error) from error
        except OSError as error:
            raise SpoolError(reason_of(error)) from error
        return result

    def _failed(self, error: sqlite3.Error) -> SpoolError:
        """Return the meaning of a database error; close the file unless the disk is full."""
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code == _FULL and self._database is not None and self._rolled_back(self._database):
            return SpoolError(f"{error}: {self.path.parent}")
        self.close()
        if code in _IN_USE:
            return SpoolError(f"another process holds {self.path}")
        if code in _DAMAGED:
            return self._set_aside(str(error))
        return SpoolError(f"{error}: {self.path.parent}")

    @staticmethod
    def _rolled_back(database: sqlite3.Connection) -> bool:
        with contextlib.suppress(sqlite3.Error):
            if database.in_transaction:
                database.execute("ROLLBACK")
            return True
        return False

    def _set_aside(self, reason: str) -> SpoolError:
        """Keep one damaged file for inspection."""
        damaged = self.path.with_suffix(".damaged")
        try:
            os.replace(self.path, damaged)
            for companion in ("-wal", "-journal"):
                with contextlib.suppress(FileNotFoundError):
                    os.replace(f"{self.path}{companion}", f"{damaged}{companion}")
        except OSError as error:
            return SpoolError(f"{self.path} is damaged ({reason}) and cannot be set aside: {meaning_of(error)}")
        return SpoolDamagedError(f"{self.path} is damaged ({reason}): set aside as {damaged.name}")

    def _open(self) -> sqlite3.Connection:
        make_directory(self.path.parent, 0o700)
        database = sqlite3.connect(self.path, timeout=0.0, isolation_level=None, check_same_thread=False)
        try:
            database.execute("PRAGMA locking_mode=EXCLUSIVE")  # a second process must not send the same events
            database.execute("PRAGMA auto_vacuum=FULL")
            database.execute("PRAGMA journal_mode=WAL")
            database.execute("BEGIN IMMEDIATE")
            self._check(database)
            for statement in _CREATE:
                database.execute(statement)
            database.execute(_SET_FORMAT)
            self._count, self._bytes = database.execute(_SIZES).fetchone()
            (newest_run,) = database.execute("SELECT coalesce(max(run), 0) FROM events").fetchone()
            database.execute("COMMIT")
            self._file = self._identity()
        except BaseException:
            database.close()
            raise
        if self._run is None:
            self._run = newest_run + 1
        self._database = database
        return database

    @staticmethod
    def _check(database: sqlite3.Connection) -> None:
        (form,) = database.execute("PRAGMA user_version").fetchone()
        (sound,) = database.execute("PRAGMA quick_check(1)").fetchone()
        if form not in (0, _FORMAT) or sound != "ok":
            error = sqlite3.DatabaseError(f"format {form}" if sound == "ok" else sound)
            error.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
            raise error
