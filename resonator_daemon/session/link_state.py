"""What is said of the link: each change of its state once, and each outage when it is over."""

import logging
from collections.abc import Callable
from typing import Final, NamedTuple

from resonator_daemon.session.clock import Instant
from resonator_daemon.session.frames import Arrival, LinkChange, Outage

log = logging.getLogger(__name__)

STATES: Final = frozenset({"waiting", "starting", "online", "stalled", "lost", "refused"})
"""All that is said of a link."""


class LinkStateSnapshot(NamedTuple):
    """What was said of a link last, "" where nothing was, and of the outage that goes on."""

    state: str
    reason: str
    since_utc_ns: int
    outage_reasons: tuple[str, ...]


class LinkState:
    """Follows one link for as long as it is wanted.

    Parameters
    ----------
    put
        Takes what is to be said.
    """

    def __init__(self, put: Callable[[Arrival], None]) -> None:
        self._put = put
        self._present: LinkChange | None = None
        self._outage_reasons: list[str] = []  # of the outage that goes on

    @property
    def state(self) -> str:
        return self._present.state if self._present else ""

    @property
    def snapshot(self) -> LinkStateSnapshot:
        """What is said now, for `join`."""
        present = self._present or LinkChange("", "", 0, 0)
        return LinkStateSnapshot(present.state, present.reason, present.since_utc_ns, tuple(self._outage_reasons))

    def join(self, snapshot: LinkStateSnapshot, utc_ns: int) -> None:
        """Go on from what was said of the link by another."""
        self._outage_reasons = list(snapshot.outage_reasons)
        if snapshot.state:
            self._present = LinkChange(snapshot.state, snapshot.reason, snapshot.since_utc_ns, utc_ns)
            self._put(self._present)

    def announce(self, state: str, reason: str, utc_ns: int) -> None:
        """Announce a state, unless it was said already; a reason alone may change."""
        before = self._present
        if before is not None and (state, reason) == (before.state, before.reason):
            return
        changed = before is None or state != before.state
        if before is not None and before.state == "online" and changed:
            self._outage_reasons = [reason]
        elif state == "lost" and self._outage_reasons:
            if reason.startswith(self._outage_reasons[-1]):  # the same, told with its cause
                self._outage_reasons.pop()
            self._outage_reasons.append(reason)
        since_utc_ns = utc_ns if changed or before is None else before.since_utc_ns
        self._present = LinkChange(state, reason, since_utc_ns, utc_ns)
        self._put(self._present)

    def frame_received(self, previous: Instant | None, this: Instant, frames_lost: int) -> None:
        """Tell of the outage that this frame has ended, if there was one; frames that were only late are none."""
        if self._outage_reasons:
            if previous is not None and frames_lost:
                # By the clock of its end: that may have been set meanwhile.
                start_utc_ns = this.utc_ns - (this.boottime_ns - previous.boottime_ns)
                self._put(Outage(start_utc_ns, this.utc_ns, frames_lost, "; ".join(self._outage_reasons)))
            self._outage_reasons = []


class LinkLog:
    """Writes to the log what was said of a link: by whoever takes it, since a log may have to be waited for."""

    def __init__(self) -> None:
        self._state = self._reason = ""

    def write(self, news: LinkChange | Outage) -> None:
        if isinstance(news, Outage):
            seconds = (news.end_utc_ns - news.start_utc_ns) * 1e-9
            log.info("outage of %.3f s is over, %d frames lost: %s", seconds, news.frames_lost, news.reason)
            return
        doubt = news.state == self._state == "online" and len(news.reason) > len(self._reason)
        if news.state != self._state or doubt:
            well = news.state in ("starting", "online") and not doubt
            level = logging.INFO if well else logging.WARNING
            log.log(level, "link %s: %s", news.state, news.reason, extra={"resonatord_link_state": news.state})
        self._state, self._reason = news.state, news.reason
