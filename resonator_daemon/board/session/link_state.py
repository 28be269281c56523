"""State of a link: each change is announced once, and each outage when it is over."""

import logging
from collections.abc import Callable
from typing import NamedTuple

from resonator_daemon.base.host.state_log import StateLog
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frames import Arrival, LinkChange, Outage
from resonator_daemon.board.session.link_reasons import OPENING, StoredReason, all_of

log = logging.getLogger(__name__)


class LinkStateSnapshot(NamedTuple):
    """State of `LinkState`: what was announced last, None before the first, and the reasons of the present outage."""

    state: Condition | None
    reason: StoredReason
    since_utc_ns: int
    outage_reasons: tuple[StoredReason, ...]


class LinkState:
    """State of one link: announces each change once, and each outage when it is over.

    Parameters
    ----------
    put
        Receives the announcements.

    Attributes
    ----------
    state
        Announced last; None before the first.
    online
        Whether that is online.
    """

    def __init__(self, put: Callable[[Arrival], None]) -> None:
        self._put = put
        self._present = LinkStateSnapshot(None, OPENING, 0, ())
        self.state: Condition | None = None
        self.online = False

    def snapshot(self) -> LinkStateSnapshot:
        return self._present

    def _set(self, present: LinkStateSnapshot) -> None:
        self._present = present
        self.state, self.online = present.state, present.state is Condition.ONLINE

    def restore(self, snapshot: LinkStateSnapshot, utc_ns: int) -> None:
        """Set the state, and announce it if there is one."""
        self._set(snapshot)
        if snapshot.state is not None:
            self._put(LinkChange(snapshot.state, snapshot.reason, snapshot.since_utc_ns, utc_ns))

    def announce(self, state: Condition, reason: Reason, utc_ns: int) -> None:
        """Announce a state, unless it was announced already; a reason alone may change."""
        before = self._present
        if (state, reason.text) == (before.state, before.reason.text):  # which has no code in old recordings
            return
        changed = state != before.state
        reasons = before.outage_reasons
        if before.state is Condition.ONLINE and changed:
            reasons = (reason,)
        elif state is Condition.LOST and reasons:
            if reason.text.startswith(reasons[-1].text):  # the same, with its cause
                reasons = reasons[:-1]
            reasons = (*reasons, reason)
        since_utc_ns = utc_ns if changed else before.since_utc_ns
        self._set(LinkStateSnapshot(state, reason, since_utc_ns, reasons))
        self._put(LinkChange(state, reason, since_utc_ns, utc_ns))

    def frame_received(self, previous: Instant | None, this: Instant, frames_lost: int) -> bool:
        """Announce the outage that this frame has ended, if there was one and frames were lost; return whether."""
        reasons = self._present.outage_reasons
        if not reasons:
            return False
        self._present = self._present._replace(outage_reasons=())
        if previous is None or not frames_lost:
            return False
        # By the clock of its end: that may have been set meanwhile.
        start_utc_ns = this.utc_ns - (this.boottime_ns - previous.boottime_ns)
        self._put(Outage(start_utc_ns, this.utc_ns, frames_lost, all_of(reasons)))
        return True


class LinkLog:
    """Writes announcements to the log, in the consumer's thread: the reader must not wait for a log."""

    def __init__(self) -> None:
        self._states = StateLog("link", log)
        self._last: tuple[Condition, ReasonCode | None] | None = None

    def write(self, event: LinkChange | Outage) -> None:
        if isinstance(event, Outage):
            if not self._states.sums_up:
                seconds = (event.end_utc_ns - event.start_utc_ns) * 1e-9
                log.info("outage of %.3f s is over, %d frames lost: %s", seconds, event.frames_lost, event.reason.text)
            return
        # While a link is looked for, its reason may be another one at each attempt.
        state = event.state, event.reason.code if event.state is Condition.ONLINE else None
        if state != self._last:
            self._last = state
            self._states.write(event.state, event.reason)

    def flush(self) -> None:
        """Write the sum of frequent changes if it is due."""
        self._states.flush()
