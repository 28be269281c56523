"""Where the publisher's messages went, counted at the instant it happens, and said in the log now and then."""

import asyncio
import logging
from collections import Counter
from enum import StrEnum
from typing import Final

FIRST_WORD_S: Final = 1.0  # after the first drop: what is dropped at once is one line
NEXT_WORD_S: Final = 60.0

log = logging.getLogger(__name__)


class Cause(StrEnum):
    """Why a message was never handed over."""

    NO_CONNECTION = "no_connection"
    QUEUE_FULL = "queue_full"
    LATE = "late"  # a stream that waited too long for the socket
    SUPERSEDED = "superseded"  # a state that gave way to a newer one: nobody misses it
    REFUSED = "refused"  # by the broker
    TOO_LARGE = "too_large"
    SPOOL_FULL = "spool_full"
    SPOOL_FAILED = "spool_failed"
    CLOSED = "closed"
    WITHDRAWN = "withdrawn"  # an answer of a connection that is over: whoever asked may be gone, too


_ON_REFUSAL: Final = (
    "; the broker's access rules refuse them to this user: does `name` match its user name or certificate?"
)

# A connection that is lost, a spool that fails and a message that is too large are said by themselves.
_SAID: Final = (Cause.QUEUE_FULL, Cause.LATE, Cause.REFUSED, Cause.SPOOL_FULL)


class Account:
    """Counts of messages by what became of them; those that wait are counted where they wait."""

    def __init__(self) -> None:
        self.made = 0
        self.restored = 0
        self.resent = 0
        self.recovered = 0
        self.acknowledged = 0
        self.handed_to_socket = 0
        self.unknown_at_disconnect = 0
        self.dropped: Counter[str] = Counter()
        self._unsaid: Counter[tuple[str, Cause]] = Counter()
        self._timer: asyncio.TimerHandle | None = None
        self._pause_s = FIRST_WORD_S

    def drop(self, cause: Cause, topic: str, count: int = 1) -> None:
        if not count:
            return
        self.dropped[cause.value] += count
        if cause in _SAID:
            self._unsaid[topic, cause] += count
            if self._timer is None:
                self._timer = asyncio.get_running_loop().call_later(self._pause_s, self._say)

    def close(self) -> None:
        """Say what is still unsaid."""
        if self._timer is not None:
            self._timer.cancel()
            self._say(last=True)

    def _say(self, *, last: bool = False) -> None:
        """Write one line about what was dropped lately; the next one a minute later at the earliest."""
        self._timer = None
        self._pause_s = NEXT_WORD_S if self._unsaid else FIRST_WORD_S
        if self._unsaid:
            what = ", ".join(f"{count} {topic} ({cause})" for (topic, cause), count in self._unsaid.items())
            refused = any(cause is Cause.REFUSED for _, cause in self._unsaid)
            log.warning("messages dropped: %s%s", what, _ON_REFUSAL if refused else "")
            self._unsaid.clear()
            if not last:
                self._timer = asyncio.get_running_loop().call_later(self._pause_s, self._say)
