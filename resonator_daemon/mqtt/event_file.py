"""The file of events: one table in the order in which they happened, and a mark up to which all are delivered.

Each batch is one transaction with a write-ahead log, not flushed to the medium (SQLite's `synchronous=NORMAL`): what
was written survives the end of the process, in whatever way. What was written before `sync` survives a power failure,
too, and the file stays in order.
"""

import contextlib
import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from resonator_daemon.base.errors import meaning_of, reason_of
from resonator_daemon.base.host.files import make_directory

WAITING_MAX: Final = 100_000  # events that are not delivered
WAITING_BYTES_MAX: Final = 64 * 2**20  # of their payloads
STORED_MAX: Final = 10_000  # of those that clients may ask for, delivered or not
STORED_NS_MAX: Final = 7 * 24 * 3600 * 10**9  # since they were written
RUNS_MAX: Final = 1000

FILE: Final = "events.sqlite3"
_FORMAT: Final = 2
_SET_FORMAT: Final = f"PRAGMA user_version={_FORMAT}"
_FULL: Final = sqlite3.SQLITE_FULL
_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_IN_USE: Final = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
_LOOKED_AT: Final = 512  # of the oldest events, for their age, with each write
_CREATE: Final = (
    """CREATE TABLE IF NOT EXISTS events (
        number INTEGER PRIMARY KEY, boot TEXT NOT NULL, seq INTEGER NOT NULL, topic TEXT NOT NULL,
        payload BLOB NOT NULL, all_bytes INTEGER NOT NULL, written_ns INTEGER NOT NULL
    )""",  # all_bytes: of payloads up to this one
    "CREATE INDEX IF NOT EXISTS events_of_run ON events (boot, seq)",
    "CREATE TABLE IF NOT EXISTS runs (id INTEGER PRIMARY KEY, boot TEXT NOT NULL UNIQUE, newest_seq INTEGER NOT NULL)",
    "CREATE TABLE IF NOT EXISTS mark (id INTEGER PRIMARY KEY, number INTEGER NOT NULL)",
)
_MARK: Final = "SELECT coalesce(max(number), 0) FROM mark"
_NEWEST: Final = "SELECT number, all_bytes FROM events ORDER BY number DESC LIMIT 1"
_IN_SPAN: Final = "FROM events WHERE number > ? AND number < ? AND NOT number BETWEEN ? AND ?"
_DELETE_OLD: Final = f"""DELETE FROM events WHERE written_ns < ? AND number IN
    (SELECT number FROM events WHERE number <= ? ORDER BY number LIMIT {_LOOKED_AT})"""
_OF_RUN: Final = "FROM events WHERE boot = ? AND number > ? AND written_ns >= ? AND seq"


class EventFileError(Exception):
    """A disk operation failed; nothing was changed."""


class EventFileDamagedError(EventFileError):
    """What was on disk cannot be read any more; it was set aside, and the next call begins again."""


class StoredEvent(NamedTuple):
    """An event with its place in the order: 0 for the first one of this run, less for those of earlier runs."""

    number: int
    boot: str
    seq: int
    topic: str
    payload: bytes


class Span(NamedTuple):
    """Numbers of the events that wait on disk alone: between both ends, without those of this run up to `passed`."""

    after: int
    before: int
    passed: int


class StoredPage(NamedTuple):
    """What is stored of a run after an event; `payloads` may end before the last of the `events`."""

    payloads: list[bytes]
    events: int
    oldest_seq: int | None
    newest_seq: int
    next_boot: str | None


class EventFile:
    """The events that wait and those of the last days, in a file that one process holds.

    To be used by one thread at a time; calls take as long as the disk does. Every method but `close` raises
    EventFileError where directory or disk refuse or another process holds the file, and EventFileDamagedError.

    Parameters
    ----------
    directory
        Made when it is missing.
    boot
        Of this run of the daemon. Empty: delivered events are not stored.

    Attributes
    ----------
    unsynced : bool
        Events were written since the last `sync`.
    """

    def __init__(self, directory: Path, boot: str) -> None:
        self.path = directory / FILE
        self._boot = boot
        self._database: sqlite3.Connection | None = None
        self._first: int | None = None  # number in the file of this run's first event
        self._mark: int | None = None  # as the file has it
        self.unsynced = False

    def open(self) -> tuple[int, int]:
        """Return the mark of earlier runs, and how many events wait behind it."""
        with self._transaction() as database:
            (mark,) = database.execute(_MARK).fetchone()
            newest, _ = database.execute(_NEWEST).fetchone() or (0, 0)
            (waiting,) = database.execute("SELECT count(*) FROM events WHERE number > ?", (mark,)).fetchone()
        self._first = newest + 1
        return mark - self._first, waiting

    def write(self, events: Sequence[StoredEvent], mark: int, span: Span) -> int:
        """Append events, store the mark, and delete what exceeds the bounds.

        Returns
        -------
        int
            Number of the oldest events in `span` that had to go.
        """
        if not events and self._mark == mark:
            return 0
        first = self._first or 0
        with self._transaction() as database:
            now_ns = time.time_ns()
            newest, all_bytes = database.execute(_NEWEST).fetchone() or (first - 1, 0)
            for event in events:
                newest, all_bytes = first + event.number, all_bytes + len(event.payload)
                row = (newest, *event[1:], all_bytes, now_ns)
                database.execute("INSERT OR REPLACE INTO events VALUES (?, ?, ?, ?, ?, ?, ?)", row)
            database.execute("INSERT OR REPLACE INTO mark VALUES (0, ?)", (first + mark,))
            held = "SELECT min(number) FROM events WHERE number > ? AND all_bytes > ?"
            (oldest,) = database.execute(held, (first + mark, all_bytes - WAITING_BYTES_MAX)).fetchone()
            oldest = max(newest - WAITING_MAX + 1, oldest or 0)
            lost: int = database.execute(f"DELETE {_IN_SPAN} AND number < ?", (*self._ends(span), oldest)).rowcount
            stored_after = newest - STORED_MAX if self._boot else newest
            database.execute("DELETE FROM events WHERE number <= ?", (min(first + mark, stored_after),))
            database.execute(_DELETE_OLD, (now_ns - STORED_NS_MAX, first + mark))
            own_seqs = [event.seq for event in events if event.boot == self._boot]
            if own_seqs:
                newest_seq = "UPDATE runs SET newest_seq = max(newest_seq, ?) WHERE boot = ?"
                database.execute(newest_seq, (own_seqs[-1], self._boot))
        self._mark = mark
        self.unsynced = self.unsynced or bool(events)
        return lost

    def read(self, span: Span, count: int) -> list[StoredEvent]:
        """Return the oldest events in `span`; they stay on disk."""
        columns = f"SELECT number - {self._first or 0}, boot, seq, topic, payload {_IN_SPAN} ORDER BY number LIMIT ?"
        with self._transaction() as database:
            return [StoredEvent(*row) for row in database.execute(columns, (*self._ends(span), count))]

    def page(self, boot: str, after_seq: int, before_seq: int | None, bytes_max: int) -> StoredPage | None:
        """Return what is stored of a run after one event and before another; None where the run is unknown.

        The page has as many payloads as the size holds, and at least one where there is any.
        """
        with self._transaction() as database:
            run = database.execute("SELECT id, newest_seq FROM runs WHERE boot = ?", (boot,)).fetchone()
            if run is None:
                return None
            run_id, newest_seq = run
            next_run = database.execute("SELECT boot FROM runs WHERE id > ? ORDER BY id LIMIT 1", (run_id,)).fetchone()
            newest, _ = database.execute(_NEWEST).fetchone() or (0, 0)
            stored = (boot, newest - STORED_MAX, time.time_ns() - STORED_NS_MAX)
            end_seq = 2**62 if before_seq is None else before_seq
            (oldest_seq,) = database.execute(f"SELECT min(seq) {_OF_RUN} < ?", (*stored, end_seq)).fetchone()
            between = (*stored, after_seq, end_seq)
            (count,) = database.execute(f"SELECT count(*) {_OF_RUN} > ? AND seq < ?", between).fetchone()
            rows = database.execute(f"SELECT payload {_OF_RUN} > ? AND seq < ? ORDER BY seq", between)
            payloads = first_of((payload for (payload,) in rows), bytes_max)
            return StoredPage(payloads, count, oldest_seq, newest_seq, next_run[0] if next_run else None)

    def sync(self) -> None:
        """Wait until the medium has all that was written."""
        with self._transaction("FULL") as database:
            database.execute(_SET_FORMAT)
        self.unsynced = False

    def close(self) -> None:
        """Close the file."""
        database, self._database = self._database, None
        if database is not None:
            with contextlib.suppress(sqlite3.Error):
                database.close()

    def _ends(self, span: Span) -> tuple[int, int, int, int]:
        first = self._first or 0
        return first + span.after, first + span.before, first, first + span.passed

    @contextlib.contextmanager
    def _transaction(self, synchronous: str = "NORMAL") -> Iterator[sqlite3.Connection]:
        """Carry out one transaction, on a database that is opened for it where it is not open.

        With `FULL`, one that writes flushes the log with all earlier ones to the medium.
        """
        try:
            database = self._database or self._open()
            database.execute(f"PRAGMA synchronous={synchronous}")
            database.execute("BEGIN IMMEDIATE")
            yield database
            database.execute("COMMIT")
        except sqlite3.Error as error:
            raise self._failed(error) from error
        except OSError as error:
            raise EventFileError(reason_of(error)) from error

    def _failed(self, error: sqlite3.Error) -> EventFileError:
        """Return the meaning of a database error; close the file unless the disk is full."""
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code == _FULL and self._database is not None and _rolled_back(self._database):
            return EventFileError(f"{error}: {self.path.parent}")
        self.close()
        if code in _IN_USE:
            return EventFileError(f"another process holds {self.path}")
        if code in _DAMAGED:
            return self._set_aside(str(error))
        return EventFileError(f"{error}: {self.path.parent}")

    def _set_aside(self, reason: str) -> EventFileError:
        """Keep one damaged file for inspection."""
        damaged = self.path.with_suffix(".damaged")
        try:
            os.replace(self.path, damaged)
            for companion in ("-wal", "-journal"):
                with contextlib.suppress(FileNotFoundError):
                    os.replace(f"{self.path}{companion}", f"{damaged}{companion}")
        except OSError as error:
            return EventFileError(f"{self.path} is damaged ({reason}) and cannot be set aside: {meaning_of(error)}")
        return EventFileDamagedError(f"{self.path} is damaged ({reason}): set aside as {damaged.name}")

    def _open(self) -> sqlite3.Connection:
        make_directory(self.path.parent, 0o700)
        database = sqlite3.connect(self.path, timeout=0.0, isolation_level=None, check_same_thread=False)
        try:
            database.execute("PRAGMA locking_mode=EXCLUSIVE")  # a second process must not send the same events
            database.execute("PRAGMA auto_vacuum=FULL")
            database.execute("PRAGMA journal_mode=WAL")
            database.execute("BEGIN IMMEDIATE")
            _check(database)
            for statement in _CREATE:
                database.execute(statement)
            database.execute(_SET_FORMAT)
            if self._boot:
                database.execute("INSERT OR IGNORE INTO runs (boot, newest_seq) VALUES (?, -1)", (self._boot,))
                database.execute("DELETE FROM runs WHERE id <= (SELECT max(id) FROM runs) - ?", (RUNS_MAX,))
            database.execute("COMMIT")
        except BaseException:
            database.close()
            raise
        self._database, self._mark = database, None
        return database


def first_of(payloads: Iterable[bytes], bytes_max: int) -> list[bytes]:
    """Return the first payloads, as many as the size holds, and at least one where there is any."""
    size_bytes = 0
    fitting: list[bytes] = []
    for payload in payloads:
        size_bytes += len(payload)
        if fitting and size_bytes > bytes_max:
            break
        fitting.append(payload)
    return fitting


def _rolled_back(database: sqlite3.Connection) -> bool:
    with contextlib.suppress(sqlite3.Error):
        if database.in_transaction:
            database.execute("ROLLBACK")
        return True
    return False


def _check(database: sqlite3.Connection) -> None:
    (form,) = database.execute("PRAGMA user_version").fetchone()
    (sound,) = database.execute("PRAGMA quick_check(1)").fetchone()
    if form not in (0, _FORMAT) or sound != "ok":
        error = sqlite3.DatabaseError(f"format {form}" if sound == "ok" else sound)
        error.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
        raise error
