"""Liveness of the daemon, for the watchdog: frames flow, or the link reports that none can."""

import logging
import time
from collections.abc import Callable

from resonator_daemon.base.reasons import Condition

log = logging.getLogger(__name__)

_FRAMES_S = 10.0  # a link that is silent for a fraction of that is no longer called online
_PATIENCE_S = 60.0  # the name of a host may take that long to look up
DECLARED_WAITING = (Condition.WAITING, Condition.STALLED, Condition.LOST, Condition.REFUSED)


class LivenessMonitor:
    """Judges a daemon by the frames that it measures.

    It is well while frames are measured. If the link reports that none can come (`waiting`, `stalled`, `lost`,
    `refused`) it is well while the reader goes on trying. A link that is `online` without frames for 10 s, one that is
    `starting` for 60 s, and a reader that does nothing for 60 s are not: a restart is the remedy.

    Parameters
    ----------
    clock_s
        Monotonic, without the time in which the computer slept.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._frames = self._turns = 0
        self._frame_s = self._turn_s = clock_s()
        self._well = True

    def healthy(self, frames: int, link_state: Condition, reader_turns: int) -> bool:
        """Update the counts and return whether the daemon is healthy; each change is logged.

        Parameters
        ----------
        frames
            That were measured since the start.
        link_state
            As in `state/link`.
        reader_turns
            How often the reader looked whether there is something to do, since the start.
        """
        now_s = self._clock_s()
        if frames != self._frames or link_state in DECLARED_WAITING:
            self._frame_s = now_s
        if reader_turns != self._turns:
            self._turn_s = now_s
        self._frames, self._turns = frames, reader_turns
        silent_s, still_s = now_s - self._frame_s, now_s - self._turn_s
        limit_s = _FRAMES_S if link_state == Condition.ONLINE else _PATIENCE_S
        problem = None
        if silent_s > limit_s:
            problem = f"no frame was measured for {silent_s:.0f} s (limit {limit_s:.0f} s), link {link_state}"
        elif still_s > _PATIENCE_S:
            problem = f"the reader of the link has stood still for {still_s:.0f} s (limit {_PATIENCE_S:.0f} s)"
        if problem and self._well:
            log.error("%s: the service manager's watchdog is no longer fed, and restarts this process", problem)
        elif not problem and not self._well:
            log.info("frames flow again: the service manager's watchdog is fed")
        self._well = not problem
        return self._well
