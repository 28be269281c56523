"""The events of the last days, on disk: what a client has missed can be asked for, also from earlier runs."""

import sqlite3
import time
from collections.abc import Awaitable, Callable
from itertools import islice
from typing import Any, Final, NamedTuple

from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import ContactEvent
from resonator_daemon.mqtt.spool import Spool, SpoolDamagedError, SpoolError

EVENTS_MAX: Final = 10_000
AGE_MAX_NS: Final = 7 * 24 * 3600 * 10**9  # since it was stored
RUNS_MAX: Final = 1000
UNWRITTEN_MAX: Final = 1024  # in memory

_TOGETHER: Final = 256  # events of one transaction
_BEGIN: Final = "INSERT OR IGNORE INTO runs (boot, newest_seq) VALUES (?, -1)"
_APPEND: Final = "INSERT OR IGNORE INTO history (boot, seq, stored_ns, payload) VALUES (?, ?, ?, ?)"
_NEWEST: Final = "UPDATE runs SET newest_seq = max(newest_seq, ?) WHERE boot = ?"
_DROP_EXCESS: Final = "DELETE FROM history WHERE id <= (SELECT max(id) FROM history) - ?"
_DROP_OLD: Final = f"""DELETE FROM history
    WHERE id IN (SELECT id FROM history ORDER BY id LIMIT {2 * _TOGETHER}) AND stored_ns < ?"""
_DROP_RUNS: Final = "DELETE FROM runs WHERE id <= (SELECT max(id) FROM runs) - ?"
_OF_RUN: Final = "FROM history WHERE boot = ? AND stored_ns >= ? AND seq"

InThread = Callable[..., Awaitable[Any]]


class UnknownRunError(Exception):
    """No run of the daemon with this identifier is recorded here, or it was too long ago."""


class HistoryPage(NamedTuple):
    """Stored events of one run, in order.

    Attributes
    ----------
    payloads
        Encoded events, the oldest first, as many as the asked size holds, and at least one where there is any.
    complete
        Whether all events of the run after the asked one are stored, on this page or beyond it.
    oldest_seq, newest_seq
        Of the oldest stored event of the run, and of the newest that happened in it; None where there is none.
    next_boot_id
        Of the next stored run of the daemon; None for the present one.
    """

    payloads: tuple[bytes, ...]
    complete: bool
    oldest_seq: int | None
    newest_seq: int | None
    next_boot_id: str | None = None


class _Stored(NamedTuple):
    """What the disk has of a run beyond an event; the page may end before the last of them."""

    payloads: list[bytes]
    events: int
    oldest_seq: int | None
    newest_seq: int
    next_boot_id: str | None


class EventHistory:
    """The events of this run and earlier ones, within bounds of number and age; from the event loop's thread only.

    An event is in memory until it is on disk. While the disk takes nothing, memory holds the newest 1024.

    Parameters
    ----------
    boot_id
        Of this run of the daemon.
    spool
        Has the file; None: memory alone.
    in_thread
        Runs a function in the thread that uses the spool.
    on_damage
        Called when the file was damaged and set aside.
    """

    def __init__(
        self, boot_id: str, spool: Spool | None, in_thread: InThread, on_damage: Callable[[SpoolDamagedError], None]
    ) -> None:
        self._boot_id = boot_id
        self._spool = spool
        self._in_thread = in_thread
        self._on_damage = on_damage
        self._begun = spool is None  # the run is on record
        self._memory: dict[int, ContactEvent] = {}  # by seq
        self._newest_seq = -1

    @property
    def unwritten(self) -> bool:
        """Whether the disk lacks something."""
        return self._spool is not None and (bool(self._memory) or not self._begun)

    def add(self, event: ContactEvent) -> None:
        """Add the newest event."""
        self._memory[event.seq] = event
        self._newest_seq = event.seq
        if len(self._memory) > UNWRITTEN_MAX:
            del self._memory[next(iter(self._memory))]

    async def write(self) -> None:
        """Write the oldest events that are not on disk yet, some hundred at most.

        Raises
        ------
        SpoolError
            The disk does not take them; they stay in memory.
        """
        if self._spool is None:
            return
        now_ns = time.time_ns()
        rows = [(self._boot_id, seq, now_ns, _payload(event)) for seq, event in islice(self._memory.items(), _TOGETHER)]
        await self._in_thread(self._spool.transact, lambda database: _append(database, self._boot_id, rows))
        self._begun = True
        for _, seq, _, _ in rows:
            self._memory.pop(seq, None)

    def lost(self) -> None:
        """Begin again, because the file was damaged and set aside."""
        self._begun = self._spool is None

    async def page(self, boot_id: str | None, after_seq: int, bytes_max: int) -> HistoryPage:
        """Return the stored events of a run, the present one where not given, beyond `after_seq`.

        Raises
        ------
        UnknownRunError
        SpoolError
            The disk cannot be read. Of the present run, what memory holds is returned instead.
        """
        present = boot_id is None or boot_id == self._boot_id
        boot_id = self._boot_id if boot_id is None else boot_id
        memory = dict(self._memory) if present else {}  # before the disk is read: what is written meanwhile is here
        newest_seq = self._newest_seq if present else -1
        stored = await self._read(boot_id, after_seq, min(memory, default=None), bytes_max, needed=not present)
        if stored is None and not present:
            raise UnknownRunError(boot_id)
        payloads, count, oldest_seq, newest_on_disk, next_on_disk = stored or _Stored([], 0, None, -1, None)
        newest_seq = max(newest_seq, newest_on_disk)
        if oldest_seq is None:
            oldest_seq = min(memory, default=None)
        missed = [event for seq, event in memory.items() if seq > after_seq]
        if len(payloads) == count:
            size_bytes = sum(map(len, payloads))
            for event in missed:
                payload = _payload(event)
                size_bytes += len(payload)
                if payloads and size_bytes > bytes_max:
                    break
                payloads.append(payload)
        complete = count + len(missed) >= newest_seq - after_seq
        next_boot_id = None if present else next_on_disk or self._boot_id
        return HistoryPage(tuple(payloads), complete, oldest_seq, newest_seq if newest_seq >= 0 else None, next_boot_id)

    async def _read(
        self, boot_id: str, after_seq: int, before_seq: int | None, bytes_max: int, *, needed: bool
    ) -> _Stored | None:
        if self._spool is None:
            return None
        try:
            found: _Stored | None = await self._in_thread(
                self._spool.transact, lambda database: _read(database, boot_id, after_seq, before_seq, bytes_max)
            )
        except SpoolError as error:
            if isinstance(error, SpoolDamagedError):
                self._on_damage(error)
            if needed:
                raise
            return None
        return found


def _payload(event: ContactEvent) -> bytes:
    return encode(event.model_copy(update={"replayed": True}))


def _append(database: sqlite3.Connection, boot_id: str, rows: list[tuple[str, int, int, bytes]]) -> None:
    database.execute(_BEGIN, (boot_id,))
    database.executemany(_APPEND, rows)
    if rows:
        database.execute(_NEWEST, (rows[-1][1], boot_id))
    database.execute(_DROP_EXCESS, (EVENTS_MAX,))
    database.execute(_DROP_OLD, (time.time_ns() - AGE_MAX_NS,))
    database.execute(_DROP_RUNS, (RUNS_MAX,))


def _read(
    database: sqlite3.Connection, boot_id: str, after_seq: int, before_seq: int | None, bytes_max: int
) -> _Stored | None:
    """Return what is stored of a run after one event and before another; None where the run is unknown."""
    run = database.execute("SELECT id, newest_seq FROM runs WHERE boot = ?", (boot_id,)).fetchone()
    if run is None:
        return None
    run_id, newest_seq = run
    next_run = database.execute("SELECT boot FROM runs WHERE id > ? ORDER BY id LIMIT 1", (run_id,)).fetchone()
    since_ns, end_seq = time.time_ns() - AGE_MAX_NS, 2**62 if before_seq is None else before_seq
    (oldest_seq,) = database.execute(f"SELECT min(seq) {_OF_RUN} < ?", (boot_id, since_ns, end_seq)).fetchone()
    between = (boot_id, since_ns, after_seq, end_seq)
    (count,) = database.execute(f"SELECT count(*) {_OF_RUN} > ? AND seq < ?", between).fetchone()
    payloads: list[bytes] = []
    size_bytes = 0
    for (payload,) in database.execute(f"SELECT payload {_OF_RUN} > ? AND seq < ? ORDER BY seq", between):
        size_bytes += len(payload)
        if payloads and size_bytes > bytes_max:
            break
        payloads.append(payload)
    return _Stored(payloads, count, oldest_seq, newest_seq, next_run[0] if next_run else None)
