"""What is said of the link: each change of its state once, and each outage when it is over."""

import logging
from collections.abc import Callable

from resonator_daemon.acquisition.clock import Instant
from resonator_daemon.acquisition.frames import Arrival, LinkChange, Outage

log = logging.getLogger(__name__)


class LinkState:
    """Follows one link for as long as it is wanted.

    Parameters
    ----------
    announce
        Takes what is to be said.
    """

    def __init__(self, announce: Callable[[Arrival], None]) -> None:
        self._announce = announce
        self._present: LinkChange | None = None
        self._outage_reason: str | None = None

    @property
    def state(self) -> str:
        return self._present.state if self._present else ""

    def say(self, state: str, reason: str, utc_ns: int) -> None:
        """Announce a state, unless it was said already; a reason alone may change."""
        before = self._present
        if before is not None and (state, reason) == (before.state, before.reason):
            return
        changed = before is None or state != before.state
        if changed:
            log.log(logging.INFO if state in ("starting", "online") else logging.WARNING, "link %s: %s", state, reason)
        if before is not None and before.state == "online" and changed:
            self._outage_reason = reason
        elif state == "lost" and self._outage_reason is not None:
            self._outage_reason += f"; {reason}"
        self._present = LinkChange(state, reason, utc_ns if changed or before is None else before.since_utc_ns)
        self._announce(self._present)

    def warn(self, doubt: str) -> None:
        """Tell the log what is odd about a link that goes on."""
        log.warning("%s", doubt)

    def frame_came(self, previous: Instant | None, this: Instant, frames_lost: int) -> None:
        """Tell of the outage that this frame has ended, if there was one."""
        if self._outage_reason is None:
            return
        if previous is not None:
            outage = Outage(previous.utc_ns, this.utc_ns, frames_lost, self._outage_reason)
            log.info(
                "outage of %.3f s is over, %d frames lost: %s",
                (this.monotonic_ns - previous.monotonic_ns) * 1e-9,
                frames_lost,
                self._outage_reason,
            )
            self._announce(outage)
        self._outage_reason = None
