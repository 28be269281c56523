"""Events on their way: in memory while the broker takes them, else on disk, and in order whatever happens."""

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, TypeVar

from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.event_history import EventHistory
from resonator_daemon.mqtt.message_account import Account, Cause
from resonator_daemon.mqtt.payloads import ContactEvent, Message
from resonator_daemon.mqtt.spool import Key, Progress, Spool, SpoolDamagedError, SpooledEvent, SpoolError

IN_MEMORY_MAX: Final = 1024
UNWRITTEN_MAX: Final = 4096  # while a disk that works is being written to
RETRY_S: Final = 5.0
LOOK_S: Final = 5.0  # how long a removed file may go unnoticed where nothing is written
SYNC_S: Final = 0.5  # between two fsyncs: how long the operating system alone may have an event
CLOSE_TIMEOUT_S: Final = 2.0
SUBSCRIBERS_S: Final = 60.0  # after a connection: how long events wait for the first subscriber
TRY_AGAIN_S: Final = 1.0

_TOGETHER: Final = 256  # events of one transaction
_READ_TOGETHER: Final = 64
_NOTHING: Final = (-1, -1)

log = logging.getLogger(__name__)
ResultT = TypeVar("ResultT")


class Event:
    """One event that waits or is on its way."""

    __slots__ = ("_content", "given", "late", "number", "over", "run", "stored", "topic")

    def __init__(self, topic: str, content: Message | bytes, number: int, run: int | None = None) -> None:
        self.topic = topic
        self._content = content
        self.number = number
        self.run = run  # None: the present one
        self.late = run is not None  # not sent on the connection that was there when it happened
        self.given = run is not None  # to the spool, whether it is written already or not
        self.stored = self.given
        self.over = False

    def key(self, present_run: int) -> Key:
        return (present_run if self.run is None else self.run, self.number)

    def payload(self, *, late: bool) -> bytes:
        """Encode the event; what comes from disk is late in any case."""
        if isinstance(self._content, bytes):
            return self._content
        return encode(self._content.model_copy(update={"replayed": True}) if late else self._content)


class EventQueue:
    """A queue of events that loses none while the disk takes them; to be used from the event loop's thread only.

    What waits lies in three places, the oldest first: the head, which is sent next and is on disk, too, where it came
    from there; what is on disk alone; the tail, the newest 1024. While there is a connection that keeps up, none is
    written to wait; each is written to the history. Disk and event loop meet in one task, which has one thing at a time
    done by a thread.

    Parameters
    ----------
    account
        Takes what is resent, recovered and dropped.
    directory
        Of the spool; None: what memory cannot hold is dropped.
    on_ready
        Called when events that had to be read can be taken.
    boot_id
        Of this run of the daemon: its events are stored for those who have missed them. None: they are not.

    Attributes
    ----------
    history
        The stored events; None without `boot_id`.
    """

    def __init__(
        self, account: Account, directory: Path | None, on_ready: Callable[[], None], *, boot_id: str | None = None
    ) -> None:
        self._account = account
        self._spool = Spool(directory) if directory is not None else None
        self._on_ready = on_ready
        self._head: deque[Event] = deque()
        self._tail: deque[Event] = deque()
        self._on_disk = 0  # and not in memory
        self.spooled = 0  # events that wait or are on their way, and are on disk
        self._number = 0
        self._run: int | None = None  # None: the spool was never open
        self._read = _NOTHING
        self._passed = -1
        self.spool_opened = self._spool is None  # by an earlier run: that goes first
        self._connected = False
        self._reconnected = False  # subscribers may return later than the daemon
        self._awaits_subscribers = False  # those that wait are sent one by one
        self._subscribers_due_s = 0.0
        self._try_again: asyncio.TimerHandle | None = None
        self._closing = False
        self._on_the_way: set[Event] = set()
        self._unneeded: list[Key] = []  # given to the spool, and over
        self._paused: set[str] = set()  # what failed lately, or is not to be done that often
        self._lasting = True  # what is written now is there for the next run
        self._failure: str | None = None  # as long as the disk fails
        self._wake = asyncio.Event()
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="spool") if self._spool is not None else None
        self._working: asyncio.Task[None] | None = None
        self.history = EventHistory(boot_id, self._spool, self._in_thread, self._abandon_disk) if boot_id else None

    @property
    def waiting(self) -> int:
        return len(self._head) + self._on_disk + len(self._tail)

    def put(self, topic: str, message: Message) -> None:
        """Append an event; where memory is full, the oldest in it goes: to the disk that has it already, or lost."""
        event = Event(topic, message, self._number)
        event.late = not self._connected
        self._number += 1
        self._tail.append(event)
        self._leave_to_disk()
        failing = bool(self._failure)
        while len(self._tail) > (IN_MEMORY_MAX if failing or self._spool is None else UNWRITTEN_MAX):
            self._drop(self._tail.popleft(), Cause.SPOOL_FAILED if failing else Cause.QUEUE_FULL)
            self._leave_to_disk()
        if self.history is not None and isinstance(message, ContactEvent):
            self.history.add(message)
        if self.history is not None or not self._connected or len(self._tail) > IN_MEMORY_MAX // 2:
            self._wake.set()

    def pop(self) -> Event | None:
        """Return what is to be sent next; None: there is nothing, or it is still on its way from the disk."""
        if not self.spool_opened or self._must_wait():
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
        self._on_the_way.add(event)
        return event

    def done(self, event: Event) -> None:
        """Remove an event that the broker has acknowledged, or that is dropped."""
        event.over = True
        self._on_the_way.discard(event)
        self.spooled -= event.stored
        if event.given and self._run is not None:
            self._unneeded.append(event.key(self._run))
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
                self._on_the_way.discard(event)
                self._head.appendleft(event)
                self._account.enqueued += 1
                self._account.resent += 1
                self._try_again = loop.call_later(TRY_AGAIN_S, self._end_wait)
                return
            self._awaits_subscribers = False
        self.done(event)

    def _must_wait(self) -> bool:
        """Return whether what is next has to wait until the one before has reached a subscriber."""
        if not self._awaits_subscribers:
            return False
        is_late = bool(self._head or self._on_disk or (self._tail and self._tail[0].late))
        return (is_late or self._reconnected) and bool(self._on_the_way or self._try_again)

    def _end_wait(self) -> None:
        self._try_again = None
        self._on_ready()

    def connected(self) -> None:
        self._connected = self._awaits_subscribers = True
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
        for queue in (self._head, self._tail):
            for event in queue:
                event.late = True
        self._wake.set()

    def start(self, on_defect: Callable[[], None]) -> None:
        """Begin to use the disk; what ends that by itself is raised by `close`."""
        if self._spool is not None:
            self._working = asyncio.create_task(self._work(self._spool), name="spool")
            self._working.add_done_callback(lambda _: on_defect())

    async def close(self) -> None:
        """Write what still waits to disk; drop it if that fails or takes more than 2 s."""
        self._closing = True
        self._wake.set()
        if self._working is not None:
            await asyncio.wait([self._working], timeout=CLOSE_TIMEOUT_S)
        if self._executor is not None:
            self._executor.shutdown(wait=False)
        cause = Cause.CLOSED if self._spool is None else Cause.SPOOL_FAILED
        for queue in (self._head, self._tail):
            for event in [event for event in queue if not event.stored]:
                queue.remove(event)
                self._drop(event, cause)
        if self._working is not None and self._working.done():
            self._working.result()
        elif self._working is not None:
            self._working.cancel()

    def _drop(self, event: Event, cause: Cause) -> None:
        self._account.drop(cause, event.topic)
        self.done(event)

    def _to_be_written(self) -> list[Event]:
        """Return the oldest events that are not safe: all while there is no connection, else those beyond a limit."""
        if self._spool is None or (self._connected and len(self._tail) <= IN_MEMORY_MAX // 2 and not self._closing):
            return []
        events: list[Event] = []
        for queue in (self._head, self._tail):
            for event in queue:
                if not event.stored:
                    events.append(event)
                    if len(events) == _TOGETHER:
                        return events
        return events

    async def _work(self, spool: Spool) -> None:
        """Write, delete and read as needed, one after the other; a failure pauses what failed alone."""
        await self._try("open", self._open(spool))
        self.spool_opened = True
        self._on_ready()
        while not self._closing:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_S):
                    await self._wake.wait()
            self._wake.clear()
            await self._work_once(spool)
        self._paused.clear()
        await self._work_once(spool)
        await self._in_thread(spool.close)

    async def _work_once(self, spool: Spool) -> None:
        if self._run is None and "open" not in self._paused:
            await self._try("open", self._open(spool))
        if self._run is None:
            return
        if "look" not in self._paused:
            await self._try("look", self._look(spool))
        while self._lasting and "write" not in self._paused and (events := self._to_be_written()):
            await self._try("write", self._write(spool, self._run, events))
        while self._lasting and "store" not in self._paused and self.history is not None and self.history.unwritten:
            await self._try("store", self.history.write())
        if self._unneeded and "delete" not in self._paused:
            await self._try("delete", self._delete(spool, self._run))
        if self._on_disk and len(self._head) <= _READ_TOGETHER // 2 and "read" not in self._paused:
            await self._try("read", self._fetch(spool, self._run))
        if spool.unsynced and "sync" not in self._paused:
            await self._try("sync", self._sync(spool))

    async def _open(self, spool: Spool) -> None:
        self._run, found = await self._in_thread(spool.open)
        self._account.enqueued += found
        self._account.recovered += found
        self._on_disk += found
        self.spooled += found
        if found:
            log.info("%d events of an earlier run wait in %s", found, spool.path)
            self._wake.set()

    async def _look(self, spool: Spool) -> None:
        """Restore a spool file that was removed: an open file outlives its name only until the process ends."""
        try:
            again = await self._in_thread(spool.make_again)
        except SpoolError:
            self._lasting = False
            raise
        self._lasting = True
        if again:
            log.warning("%s was removed or replaced: made again; %d events wait in it", spool.path, self.spooled)

    async def _write(self, spool: Spool, run: int, events: Sequence[Event]) -> None:
        for event in events:
            event.given = True
        rows = [SpooledEvent(event.key(run), event.topic, event.payload(late=True)) for event in events]
        removed = await self._in_thread(spool.append, rows, self._progress(run), self._on_disk)
        self._on_disk -= removed
        self.spooled -= removed
        self._account.drop(Cause.SPOOL_FULL, "events", removed)
        for event in events:
            if not event.over:
                event.stored = True
                self.spooled += 1

        self._leave_to_disk()

    def _leave_to_disk(self) -> None:
        """Remove from memory what it cannot hold and the disk has."""
        while len(self._tail) > IN_MEMORY_MAX and self._tail[0].stored:
            self._tail.popleft()
            self._on_disk += 1

    async def _delete(self, spool: Spool, _run: int) -> None:
        keys = self._unneeded[:]
        await self._in_thread(spool.delete, keys)
        del self._unneeded[: len(keys)]

    async def _sync(self, spool: Spool) -> None:
        await self._in_thread(spool.sync)
        self._pause("sync", SYNC_S)

    async def _fetch(self, spool: Spool, run: int) -> None:
        """Read the oldest events into memory; where there are fewer than were written, somebody else deleted them."""
        count = min(self._on_disk, _READ_TOGETHER)
        rows = await self._in_thread(spool.read, self._progress(run), count)
        self._on_disk -= count
        self._lose(count - len(rows))
        for row in rows:
            self._head.append(Event(row.topic, row.payload, number=row.key[1], run=row.key[0]))
            self._read = row.key
        self._on_ready()

    def _progress(self, run: int) -> Progress:
        return Progress(self._read, (run, self._passed))

    def _lose(self, count: int) -> None:
        self.spooled -= count
        self._account.drop(Cause.SPOOL_FAILED, "events", count)

    async def _try(self, what: str, work: Coroutine[object, object, None]) -> None:
        """Access the disk; a failure is logged once per change and retried later."""
        try:
            await work
        except SpoolDamagedError as error:
            self._abandon_disk(error)
        except SpoolError as error:
            self._log_change(
                logging.WARNING, f"events cannot be kept on disk ({error}): memory has the newest {IN_MEMORY_MAX}"
            )
            self._pause(what, RETRY_S)
        else:
            unwritten = bool(self._to_be_written()) or (self.history is not None and self.history.unwritten)
            if self._failure and self._lasting and not self._paused and not unwritten:
                self._log_change(logging.INFO, "events can be kept on disk again")
                self._failure = None

    def _pause(self, what: str, seconds: float) -> None:
        self._paused.add(what)
        asyncio.get_running_loop().call_later(seconds, self._resume, what)

    def _resume(self, what: str) -> None:
        self._paused.discard(what)
        self._wake.set()

    def _abandon_disk(self, error: SpoolDamagedError) -> None:
        """Go on with what is in memory: the rest went with the damaged file."""
        self._log_change(logging.WARNING, str(error))
        self._wake.set()
        self._lose(self._on_disk)
        self._on_disk = self.spooled = 0
        self._unneeded.clear()
        if self.history is not None:
            self.history.lost()
        for event in (*self._head, *self._tail, *self._on_the_way):
            event.stored = event.given = False
        self._on_ready()

    def _log_change(self, level: int, text: str) -> None:
        if text != self._failure:
            log.log(level, "%s", text)
        self._failure = text

    async def _in_thread(self, work: Callable[..., ResultT], *arguments: object) -> ResultT:
        return await asyncio.get_running_loop().run_in_executor(self._executor, work, *arguments)
