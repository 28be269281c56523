"""Notices that a link has brought no frames for so long that nothing can be said of the contacts any more."""

from collections.abc import Callable
from typing import Final, Protocol

CONTACTS_END_S: Final = 0.5  # as long as a contact of which nothing is known is kept while frames do come


class Timer(Protocol):
    """A call that is to come."""

    def cancel(self) -> None: ...


CallLater = Callable[[float, Callable[[], None]], Timer]


class Silence:
    """Calls back once when the link has not been online for half a second.

    Parameters
    ----------
    announce
        Called with the reason.
    call_later
        Of the event loop, where the present is what counts; None where `passed` tells all that passes.
    """

    def __init__(self, announce: Callable[[str], None], call_later: CallLater | None) -> None:
        self._announce = announce
        self._call_later = call_later
        self._timer: Timer | None = None
        self._due_utc_ns: int | None = None
        self._silent = False

    def watch(self, link_state: str, utc_ns: int) -> None:
        """Take the link's state as it changes, and when it did."""
        self.passed(utc_ns)
        if link_state == "online":
            self.stop()
        elif not self._silent:
            self._silent = True
            self._due_utc_ns = utc_ns + round(CONTACTS_END_S * 1e9)
            if self._call_later is not None:
                self._timer = self._call_later(CONTACTS_END_S, self._tell)

    def passed(self, utc_ns: int) -> None:
        """Take note of what time it is."""
        if self._due_utc_ns is not None and utc_ns >= self._due_utc_ns:
            self._tell()

    def stop(self) -> None:
        """Forget a silence that is over, or is of no interest any more."""
        self._silent = False
        self._end()

    def _tell(self) -> None:
        self._end()
        self._announce(f"no frames for {CONTACTS_END_S:g} s")

    def _end(self) -> None:
        self._due_utc_ns = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
