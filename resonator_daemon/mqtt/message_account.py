"""Counts of the publisher's messages by outcome, with a log line about drops at most once a minute."""

import asyncio
import logging
from collections import Counter
from enum import StrEnum
from typing import Final

from resonator_daemon.mqtt.payloads import MessageAccount

FIRST_LINE_S: Final = 1.0  # after the first drop: what is dropped at once is one line
NEXT_LINE_S: Final = 60.0

log = logging.getLogger(__name__)


class Cause(StrEnum):
    """Why a message was never handed over."""

    NOT_CONNECTED_YET = "not_connected_yet"  # a stream before the first connection: it had no subscribers to miss it
    NO_CONNECTION = "no_connection"
    QUEUE_FULL = "queue_full"
    LATE = "late"  # a stream that waited too long for the socket
    SUPERSEDED = "superseded"  # a state that gave way to a newer one: nobody misses it
    REFUSED = "refused"  # by the broker
    TOO_LARGE = "too_large"
    SPOOL_FULL = "spool_full"
    SPOOL_FAILED = "spool_failed"
    CLOSED = "closed"
    WITHDRAWN = "withdrawn"  # an answer of a connection that is over: its requester may be gone, too


_ON_REFUSAL: Final = (
    "; the broker's access rules refuse them to this user: does `name` match its user name or certificate?"
)

_NOT_MISSED: Final = (Cause.SUPERSEDED, Cause.NOT_CONNECTED_YET)
# A connection that is lost, a spool that fails and a message that is too large are logged where they occur.
_LOGGED: Final = (Cause.QUEUE_FULL, Cause.LATE, Cause.REFUSED, Cause.SPOOL_FULL)


class Account:
    """Counts of messages by what became of them; those that wait are counted where they wait.

    Attributes
    ----------
    missed
        Of those that were dropped, what subscribers miss: `lost.publish_dropped` of the messages to come. Streams
        before the first connection, states that a newer one replaced, and late messages do not count.
    late
        Those that waited too long for the socket; part of `lost.skipped_late` of the messages to come.
    """

    def __init__(self) -> None:
        self.enqueued = 0
        self.republished = 0
        self.resent = 0
        self.recovered = 0
        self.acknowledged = 0
        self.written = 0
        self.unknown_at_disconnect = 0
        self.dropped: Counter[str] = Counter()
        self.missed = 0
        self.late = 0
        self._unlogged: Counter[tuple[str, Cause]] = Counter()
        self._timer: asyncio.TimerHandle | None = None
        self._pause_s = FIRST_LINE_S

    def drop(self, cause: Cause, topic: str, count: int = 1) -> None:
        if not count:
            return
        self.dropped[cause.value] += count
        if cause is Cause.LATE:
            self.late += count
        elif cause not in _NOT_MISSED:
            self.missed += count
        if cause in _LOGGED:
            self._unlogged[topic, cause] += count
            if self._timer is None:
                self._timer = asyncio.get_running_loop().call_later(self._pause_s, self._log_drops)

    def message(self, *, waiting: int, spooled: int) -> MessageAccount:
        """Return all counts, with those that wait, and those of them that are on disk."""
        counts = {key: value for key, value in vars(self).items() if key in MessageAccount.model_fields}
        return MessageAccount(**counts | {"dropped": dict(self.dropped), "waiting": waiting, "spooled": spooled})

    def close(self) -> None:
        """Log the drops that are not logged yet."""
        if self._timer is not None:
            self._timer.cancel()
            self._log_drops(last=True)

    def _log_drops(self, *, last: bool = False) -> None:
        """Write one line about what was dropped lately; the next one a minute later at the earliest."""
        self._timer = None
        self._pause_s = NEXT_LINE_S if self._unlogged else FIRST_LINE_S
        if self._unlogged:
            what = ", ".join(f"{count} {topic} ({cause})" for (topic, cause), count in self._unlogged.items())
            refused = any(cause is Cause.REFUSED for _, cause in self._unlogged)
            log.warning("messages dropped: %s%s", what, _ON_REFUSAL if refused else "")
            self._unlogged.clear()
            if not last:
                self._timer = asyncio.get_running_loop().call_later(self._pause_s, self._log_drops)
