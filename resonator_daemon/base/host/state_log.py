"""One log line for each change of a state; frequent changes are summed up."""

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from resonator_daemon.base.reasons import Condition, Reason, ReasonCode

SUM_S: Final = 20.0
SINGLE_MAX: Final = 6  # changes within `SUM_S` that have a line each
STEADY_S: Final = 4.0  # above `SUM_S / SINGLE_MAX`, so that sums add no more lines

_NOTHING_WRONG: Final = (Condition.STARTING, Condition.ONLINE, Condition.OFFLINE)
_DOUBTS: Final = (  # in spite of a good state
    ReasonCode.BAD_CONFIGURATION,
    ReasonCode.CHANNELS_SILENT,
    ReasonCode.COMPUTER_BUSY,
    ReasonCode.DECODER_CRASHED,
    ReasonCode.DECODER_HUNG,
    ReasonCode.FIT_CONTRADICTED,
    ReasonCode.FRAME_KIND,
    ReasonCode.FRAME_LENGTH,
    ReasonCode.FRAME_PART,
    ReasonCode.FRAME_TICKS,
    ReasonCode.MESSAGE_FIELDS,
    ReasonCode.NAME_CONFLICT,
    ReasonCode.NO_PONG,
    ReasonCode.RESTART_NEEDED,
    ReasonCode.SENSOR_SUSPECT,
    ReasonCode.SITES_SILENT,
    ReasonCode.TICK_RATE,
    ReasonCode.TOO_NOISY,
    ReasonCode.UNDECODABLE,
)


def needs_a_person(condition: Condition, code: ReasonCode) -> bool:
    """Return whether somebody has to act; a sensor that waits for frames has a link with the reason."""
    if condition is Condition.WAITING and code is ReasonCode.NO_FRAMES:
        return False
    return condition not in _NOTHING_WRONG or code in _DOUBTS


class StateLog:
    """Writes one line for each change of a state, with its reason code; frequent changes are summed up in one line.

    A change is another condition or another reason code. The first six within 20 s have a line each. Further
    changes are summed up, every 20 s or once a state has lasted for 4 s: one line has their number and the latest
    state. Lines are warnings if a person has to act.

    Parameters
    ----------
    subject
        Owner of the state: `daemon`, `link` or `sensor`.
    log
        Where the lines go.
    clock
        Monotonic, in seconds.
    """

    def __init__(self, subject: str, log: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._subject = subject
        self._log = log
        self._clock = clock
        self._last: tuple[Condition, ReasonCode] | None = None
        self._reason = ""
        self._changed_s: deque[float] = deque(maxlen=SINGLE_MAX)
        self._since_s = 0.0  # of the first change without a line
        self._count = 0  # of changes without a line
        self._warn = False

    @property
    def sums_up(self) -> bool:
        """Whether changes are being summed up at present."""
        return self._count > 0

    def write(self, condition: Condition, reason: Reason) -> None:
        """Write a line, or count a change, if this is another state than before."""
        state = condition, reason.code
        if state == self._last:
            return
        self.flush()
        now_s = self._clock()
        frequent = len(self._changed_s) == SINGLE_MAX and now_s - self._changed_s[0] < SUM_S
        self._last, self._reason = state, reason.text
        single = not self._count and not frequent
        self._since_s = self._since_s if self._count else now_s
        self._count += 1
        self._changed_s.append(now_s)
        self._warn = self._warn or needs_a_person(*state)
        if single:
            self._write_line(now_s)

    def flush(self) -> None:
        """Write the sum if it is due; to be called now and then, since changes may end."""
        now_s = self._clock()
        if self._count and (now_s - self._since_s >= SUM_S or now_s - self._changed_s[-1] >= STEADY_S):
            self._write_line(now_s)

    def _write_line(self, now_s: float) -> None:
        if self._last is not None:
            head = self._subject
            if self._count > 1:
                head += f": {self._count} changes in {now_s - self._since_s:.0f} s; now"
            level = logging.WARNING if self._warn else logging.INFO
            names = f"resonatord_{self._subject}_state", "resonatord_reason_code"
            fields = dict(zip(names, self._last, strict=True))
            self._log.log(level, "%s %s (%s): %s", head, *self._last, self._reason, extra=fields)
        self._count, self._warn = 0, False
