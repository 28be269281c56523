"""Timeout of a link without frames, after which nothing is known of the contacts."""

from collections.abc import Callable
from typing import Final, Protocol

from resonator_daemon.base.reasons import Condition, Reason, ReasonCode

CONTACTS_END_S: Final = 0.5  # as long as a contact of which nothing is known is kept while frames do come


class Timer(Protocol):
    """A scheduled call."""

    def cancel(self) -> None: ...


CallLater = Callable[[float, Callable[[], None]], Timer]


class FrameTimeout:
    """Calls back once if the link has not been online for half a second.

    Parameters
    ----------
    expire
        Called with the reason.
    call_later
        Of the event loop, for which the present counts; None if all time passes by `passed`.

    Attributes
    ----------
    due_utc_ns
        When it calls back, unless frames come; None while they do.
    """

    def __init__(self, expire: Callable[[Reason], None], call_later: CallLater | None) -> None:
        self._expire = expire
        self._call_later = call_later
        self._timer: Timer | None = None
        self.due_utc_ns: int | None = None
        self._waiting = False

    def watch(self, link_state: Condition, utc_ns: int) -> None:
        """Follow a change of the link's state."""
        self.passed(utc_ns)
        if link_state == Condition.ONLINE:
            self.stop()
        elif not self._waiting:
            self._waiting = True
            self.due_utc_ns = utc_ns + round(CONTACTS_END_S * 1e9)
            if self._call_later is not None:
                self._timer = self._call_later(CONTACTS_END_S, self._run_out)

    def passed(self, utc_ns: int) -> None:
        """End the contacts if the time limit has passed at this moment."""
        if self.due_utc_ns is not None and utc_ns >= self.due_utc_ns:
            self._run_out()

    def stop(self) -> None:
        """Stop waiting."""
        self._waiting = False
        self._end()

    def _run_out(self) -> None:
        self._end()
        self._expire(Reason(ReasonCode.NO_FRAMES, f"no frames for {CONTACTS_END_S:g} s"))

    def _end(self) -> None:
        self.due_utc_ns = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
