"""Event log with a delivery mark: events after the mark wait for the broker; clients request ranges."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain, islice
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.event_file import (
    EventFile,
    EventFileDamagedError,
    EventFileError,
    Span,
    StoredEvent,
    StoredPage,
    first_of,
)
from resonator_daemon.mqtt.message_account import Account, Cause
from resonator_daemon.mqtt.payloads import ContactEvent

IN_MEMORY_MAX: Final = 1024
UNWRITTEN_MAX: Final = 4096  # while a disk that works is being written to
RETRY_S: Final = 5.0
SYNC_S: Final = 0.5  # between two fsyncs: how long the operating system alone may have an event
CLOSE_TIMEOUT_S: Final = 2.0
SUBSCRIBERS_S: Final = 60.0  # after a connection: how long events wait for the first subscriber
TRY_AGAIN_S: Final = 1.0

_TOGETHER: Final = 256  # events of one transaction
_READ_TOGETHER: Final = 64

log = logging.getLogger(__name__)
ResultT = TypeVar("ResultT")


class UnknownRunError(Exception):
    """No run of the daemon with this identifier is recorded here, or it was too long ago."""


class EventPage(NamedTuple):
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


class Event:
    """One event; `late`: it is not sent on the connection that was there when it happened."""

    __slots__ = ("_content", "boot", "late", "number", "seq", "stored", "topic")

    def __init__(self, number: int, boot: str, seq: int, topic: str, content: ContactEvent | bytes) -> None:
        self.number = number
        self.boot = boot
        self.seq = seq
        self.topic = topic
        self._content = content
        self.late = self.stored = isinstance(content, bytes)  # read from disk

    def payload(self, *, late: bool) -> bytes:
        """Encode the event; what comes from disk is late in any case."""
        if isinstance(self._content, bytes):
            return self._content
        return encode(self._content.model_copy(update={"replayed": True}) if late else self._content)


class EventLog:
    """The events of this run and earlier ones, in order; to be used from the event loop's thread only.

    Each event is written to the file soon after it happened, and sent independently of that. Memory has the newest 1024
    that wait, those that are sent next, and those that the disk lacks. Disk and event loop meet in one task, which has
    one thing at a time done by a thread.

    Parameters
    ----------
    account
        Takes what is resent, recovered and dropped.
    directory
        Of the file; None: what memory cannot hold is dropped.
    on_ready
        Called when events that had to be read can be taken.
    boot_id
        Of this run of the daemon. None: `page` is not used, and the file has those events only that wait.
    """

    def __init__(
        self, account: Account, directory: Path | None, on_ready: Callable[[], None], *, boot_id: str | None = None
    ) -> None:
        self._account = account
        self._boot_id = boot_id or ""
        self._file = EventFile(directory, self._boot_id) if directory is not None else None
        self._on_ready = on_ready
        self._count = 0  # events of this run
        self._newest_seq = -1
        # What waits, the oldest first: what was read or is sent again, what is on disk alone, the newest.
        self._head: deque[Event] = deque()
        self._on_disk = 0
        self._tail: deque[Event] = deque()
        self._on_the_way: dict[int, Event] = {}
        self._unwritten: deque[Event] = deque()  # delivered or not
        self._read = self._passed = -1  # numbers up to which events have left the disk for memory, and the tail
        self._file_known = False  # numbers of earlier runs are
        self.opened = self._file is None  # or could not be; events of earlier runs go first
        self._connected = False
        self._connected_at = 0  # number of the first event on the present connection
        self._reconnected = False  # subscribers may return later than the daemon
        self._awaits_subscribers = False  # those that wait are sent one by one
        self._subscribers_due_s = 0.0
        self._try_again: asyncio.TimerHandle | None = None
        self._closing = False
        self._paused: set[str] = set()  # what failed lately, or is not to be done that often
        self._failure: str | None = None  # as long as the disk fails
        self._wake = asyncio.Event()
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="events") if self._file is not None else None
        self._working: asyncio.Task[None] | None = None

    @property
    def waiting(self) -> int:
        return len(self._head) + self._on_disk + len(self._tail)

    @property
    def spooled(self) -> int:
        """Number of events that wait or are on their way, and are on disk."""
        return self._on_disk + sum(event.stored for event in self._undelivered()) if self._file is not None else 0

    def put(self, topic: str, message: ContactEvent) -> None:
        """Append an event; where memory is full, the oldest in it goes: to the disk that has it already, or lost."""
        event = Event(self._count, self._boot_id, message.seq, topic, message)
        self._count, self._newest_seq = self._count + 1, message.seq
        self._tail.append(event)
        if self._file is not None or self._boot_id:
            self._unwritten.append(event)
        self._leave_to_disk()
        failing = self._failure is not None
        memory_max = IN_MEMORY_MAX if failing or self._file is None else UNWRITTEN_MAX
        while len(self._tail) > memory_max:
            self._account.drop(Cause.SPOOL_FAILED if failing else Cause.QUEUE_FULL, self._tail.popleft().topic)
            self._leave_to_disk()
        while len(self._unwritten) > memory_max:
            self._unwritten.popleft()
        self._wake.set()

    def pop(self) -> Event | None:
        """Return what is to be sent next; None: there is nothing, or it is still on its way from the disk."""
        if not self.opened or self._must_wait():
            return None
        if len(self._head) <= _READ_TOGETHER // 2 and self._on_disk:
            self._wake.set()
        if self._head:
            event = self._head.popleft()
        elif self._on_disk or not self._tail:
            return None
        else:
            event = self._tail.popleft()
            self._passed = event.number
        event.late = self._is_late(event)
        self._on_the_way[event.number] = event
        return event

    def done(self, event: Event) -> None:
        """Remove an event that the broker has acknowledged, or that is dropped."""
        self._on_the_way.pop(event.number, None)
        self._wake.set()

    def answered(self, event: Event, *, has_subscribers: bool) -> None:
        """Remove an event that the broker has acknowledged; one that waits for a subscriber is queued again.

        Subscribers connect again later than the daemon, and a broker without its store has nothing for them. On the
        first connection late events wait for them, on further ones all.
        """
        if has_subscribers:
            self._awaits_subscribers = False
        elif self._awaits_subscribers and (event.late or self._reconnected):
            loop = asyncio.get_running_loop()
            if loop.time() < self._subscribers_due_s:
                event.late = True
                self._on_the_way.pop(event.number, None)
                self._head.appendleft(event)
                self._account.enqueued += 1
                self._account.resent += 1
                self._try_again = loop.call_later(TRY_AGAIN_S, self._end_wait)
                return
            self._awaits_subscribers = False
        self.done(event)

    def connected(self) -> None:
        self._connected = self._awaits_subscribers = True
        self._connected_at = self._count
        self._subscribers_due_s = asyncio.get_running_loop().time() + SUBSCRIBERS_S

    def disconnected(self, unknown: Sequence[Event]) -> None:
        """Queue the events that were in flight again: they may not have arrived."""
        self._connected = False
        self._reconnected = True
        if self._try_again is not None:
            self._try_again.cancel()
            self._try_again = None
        self._on_the_way.clear()
        self._account.enqueued += len(unknown)
        self._account.resent += len(unknown)
        self._head.extendleft(reversed(unknown))

    async def page(self, boot_id: str | None, after_seq: int, bytes_max: int) -> EventPage:
        """Return the stored events of a run, the present one where not given, beyond `after_seq`.

        Raises
        ------
        UnknownRunError
        EventFileError
            The disk cannot be read. Of the present run, what memory holds is returned instead.
        """
        if not self._boot_id:
            raise ValueError("events are stored under a boot_id only")
        boot_id = self._boot_id if boot_id is None else boot_id
        present = boot_id == self._boot_id
        unwritten = [event for event in self._unwritten if event.boot == boot_id]  # as it is before the disk is read
        newest_seq = self._newest_seq if present else -1
        stored = await self._stored(boot_id, after_seq, unwritten[0].seq if unwritten else None, bytes_max, present)
        missed = [event for event in unwritten if event.seq > after_seq]
        payloads, oldest_seq = stored.payloads, stored.oldest_seq
        if len(payloads) == stored.events:
            payloads = first_of(chain(payloads, (event.payload(late=True) for event in missed)), bytes_max)
        if oldest_seq is None and unwritten:
            oldest_seq = unwritten[0].seq
        newest_seq = max(newest_seq, stored.newest_seq)
        complete = stored.events + len(missed) >= newest_seq - after_seq
        next_boot_id = None if present else stored.next_boot or self._boot_id
        return EventPage(tuple(payloads), complete, oldest_seq, newest_seq if newest_seq >= 0 else None, next_boot_id)

    def start(self, on_defect: Callable[[], None]) -> None:
        """Begin to use the disk; what ends that by itself is raised by `close`."""
        if self._file is not None:
            self._working = asyncio.create_task(self._work(self._file), name="events")
            self._working.add_done_callback(lambda _: on_defect())

    async def close(self) -> None:
        """Write what still waits to disk; drop it if that fails or takes more than 2 s."""
        self._closing = True
        self._wake.set()
        if self._working is not None:
            await asyncio.wait([self._working], timeout=CLOSE_TIMEOUT_S)
        if self._executor is not None:
            self._executor.shutdown(wait=False)
        for queue in (self._head, self._tail):
            for event in [event for event in queue if not event.stored]:
                queue.remove(event)
                self._account.drop(Cause.CLOSED if self._file is None else Cause.SPOOL_FAILED, event.topic)
        if self._working is not None and self._working.done():
            self._working.result()
        elif self._working is not None:
            self._working.cancel()

    def _undelivered(self) -> chain[Event]:
        """Return the undelivered events that memory has."""
        return chain(self._on_the_way.values(), self._head, self._tail)

    def _is_late(self, event: Event) -> bool:
        return event.late or event.number < self._connected_at or not self._connected

    def _must_wait(self) -> bool:
        """Return whether what is next has to wait until the one before has reached a subscriber."""
        if not self._awaits_subscribers:
            return False
        is_late = bool(self._head or self._on_disk or (self._tail and self._is_late(self._tail[0])))
        return (is_late or self._reconnected) and bool(self._on_the_way or self._try_again)

    def _end_wait(self) -> None:
        self._try_again = None
        self._on_ready()

    def _leave_to_disk(self) -> None:
        """Remove from memory what it cannot hold and the disk has."""
        while len(self._tail) > IN_MEMORY_MAX and self._tail[0].stored:
            event = self._tail.popleft()
            if not self._on_disk:
                self._read = max(self._read, event.number - 1)
            self._on_disk += 1

    def _span(self) -> Span:
        return Span(self._read, self._tail[0].number if self._tail else self._count, self._passed)

    def _mark(self) -> int:
        """Return the number up to which all events are delivered."""
        first = min((event.number for event in chain(self._on_the_way.values(), self._head)), default=self._count)
        if self._tail:
            first = min(first, self._tail[0].number)
        return min(first - 1, self._read) if self._on_disk else first - 1

    async def _work(self, file: EventFile) -> None:
        """Write and read as needed, one after the other; a failure pauses what failed alone."""
        await self._try("write", self._write(file))
        self.opened = True
        self._on_ready()
        while not self._closing:
            await self._wake.wait()
            self._wake.clear()
            await self._work_once(file)
        self._paused.clear()
        await self._work_once(file)
        await self._in_thread(file.close)

    async def _work_once(self, file: EventFile) -> None:
        if "write" not in self._paused:
            await self._try("write", self._write(file))
        if self._on_disk and len(self._head) <= _READ_TOGETHER // 2 and "read" not in self._paused:
            await self._try("read", self._fetch(file))
        if file.unsynced and "sync" not in self._paused:
            await self._try("sync", self._sync(file))

    async def _write(self, file: EventFile) -> None:
        """Write what the disk lacks."""
        if not self._file_known:
            mark, found = await self._in_thread(file.open)
            self._file_known = True
            self._read = mark if found else self._read
            self._on_disk += found
            self._account.enqueued += found
            self._account.recovered += found
            if found:
                log.info("%d events of an earlier run wait in %s", found, file.path)
        more = True
        while more:
            batch = list(islice(self._unwritten, _TOGETHER))
            more = len(batch) == _TOGETHER
            rows = [StoredEvent(e.number, e.boot, e.seq, e.topic, e.payload(late=True)) for e in batch]
            removed = await self._in_thread(file.write, rows, self._mark(), self._span())
            self._on_disk -= removed
            self._account.drop(Cause.SPOOL_FULL, "events", removed)
            for event in batch:
                event.stored = True
            while batch and self._unwritten and self._unwritten[0].number <= batch[-1].number:
                self._unwritten.popleft()
            self._leave_to_disk()

    async def _fetch(self, file: EventFile) -> None:
        """Read the oldest events into memory; where there are fewer than were written, somebody else deleted them."""
        count = min(self._on_disk, _READ_TOGETHER)
        rows = await self._in_thread(file.read, self._span(), count)
        self._on_disk -= count
        self._account.drop(Cause.SPOOL_FAILED, "events", count - len(rows))
        for row in rows:
            self._head.append(Event(*row))
            self._read = row.number
        self._on_ready()

    async def _sync(self, file: EventFile) -> None:
        await self._in_thread(file.sync)
        self._pause("sync", SYNC_S)

    async def _stored(
        self, boot_id: str, after_seq: int, before_seq: int | None, bytes_max: int, present: bool
    ) -> StoredPage:
        """Return what the disk has of a run; nothing of the present one where the disk fails."""
        stored: StoredPage | None = None
        if self._file is not None:
            try:
                stored = await self._in_thread(self._file.page, boot_id, after_seq, before_seq, bytes_max)
            except EventFileError as error:
                if isinstance(error, EventFileDamagedError):
                    self._begin_again(error)
                if not present:
                    raise
        if stored is None and not present:
            raise UnknownRunError(boot_id)
        return stored or StoredPage([], 0, None, -1, None)

    async def _try(self, what: str, work: Coroutine[object, object, None]) -> None:
        """Access the disk; a failure is logged once per change and retried later."""
        try:
            await work
        except EventFileDamagedError as error:
            self._begin_again(error)
        except EventFileError as error:
            self._log_change(
                logging.WARNING, f"events cannot be kept on disk ({error}): memory has the newest {IN_MEMORY_MAX}"
            )
            self._pause(what, RETRY_S)
        else:
            if self._failure and not self._paused and not self._unwritten:
                self._log_change(logging.INFO, "events can be kept on disk again")
                self._failure = None

    def _pause(self, what: str, seconds: float) -> None:
        self._paused.add(what)
        asyncio.get_running_loop().call_later(seconds, self._resume, what)

    def _resume(self, what: str) -> None:
        self._paused.discard(what)
        self._wake.set()

    def _begin_again(self, error: EventFileDamagedError) -> None:
        """Write what is in memory to a new file: the rest went with the damaged one."""
        self._log_change(logging.WARNING, str(error))
        self._account.drop(Cause.SPOOL_FAILED, "events", self._on_disk)
        self._on_disk = 0
        lacking = {event.number: event for event in chain(self._undelivered(), self._unwritten)}
        self._unwritten = deque(lacking[number] for number in sorted(lacking))
        for event in self._unwritten:
            event.stored = False
        self._wake.set()
        self._on_ready()

    def _log_change(self, level: int, text: str) -> None:
        if text != self._failure:
            log.log(level, "%s", text)
        self._failure = text

    async def _in_thread(self, work: Callable[..., ResultT], *arguments: object) -> ResultT:
        return await asyncio.get_running_loop().run_in_executor(self._executor, work, *arguments)
