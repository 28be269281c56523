"""One log line for each change of a state; frequent changes are summed up."""

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from resonator_daemon.conditions import Condition
from resonator_daemon.reasons import Reason, ReasonCode

SUM_S: Final = 20.0
SINGLE_MAX: Final = 6  # changes within `SUM_S` that have a line each

_NOTHING_WRONG: Final = (Condition.STARTING, Condition.ONLINE, Condition.OFFLINE)
_DOUBTS: Final = (  # in spite of a good state
    ReasonCode.BAD_CONFIGURATION,
    ReasonCode.CHANNELS_SILENT,
    ReasonCode.DECODER_CRASHED,
    ReasonCode.DECODER_HUNG,
    ReasonCode.FRAME_KIND,
    ReasonCode.FRAME_LENGTH,
    ReasonCode.FRAME_PART,
    ReasonCode.FRAME_TICKS,
    ReasonCode.MESSAGE_FIELDS,
    ReasonCode.NAME_CONFLICT,
    ReasonCode.NO_PONG,
    ReasonCode.RESTART_NEEDED,
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
    """Writes one line for each change of a state, with its reason code; of frequent changes it writes a sum.

    A change is another condition or another reason code. The first six within 20 s have a line each. From then on one
    line has their number and the latest state, every 20 s. Lines are warnings where a person has to act.

    Parameters
    ----------
    subject
        Whose state it is: `daemon`, `link` or `sensor`.
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
        self._since_s: float | None = None
        self._count = 0
        self._warn = False

    @property
    def sums_up(self) -> bool:
        """Whether changes are being summed up at present."""
        return self._since_s is not None

    def write(self, condition: Condition, reason: Reason) -> None:
        """Write a line, or count a change, if this is another state than before."""
        state = condition, reason.code
        if state == self._last:
            return
        now_s = self._clock()
        self.flush()
        self._last, self._reason = state, reason.text
        if self._since_s is None:
            full = len(self._changed_s) == SINGLE_MAX
            if not full or now_s - self._changed_s[0] >= SUM_S:
                self._changed_s.append(now_s)
                self._line("%s %s (%s): %s", self._subject, *state, reason.text, warn=needs_a_person(*state))
                return
            self._since_s, self._count, self._warn = now_s, 0, False
        self._count += 1
        self._changed_s.append(now_s)
        self._warn = self._warn or needs_a_person(*state)

    def flush(self) -> None:
        """Write the sum if it is due; to be called now and then, since changes may end."""
        if self._since_s is None or self._last is None:
            return
        elapsed_s = self._clock() - self._since_s
        if elapsed_s < SUM_S:
            return
        self._since_s = None
        self._line(
            "%s: %d changes in %.0f s; now %s (%s): %s",
            self._subject,
            self._count,
            elapsed_s,
            *self._last,
            self._reason,
            warn=self._warn,
        )

    def _line(self, form: str, *values: object, warn: bool) -> None:
        if self._last is not None:
            condition, code = self._last
            fields = {f"resonatord_{self._subject}_state": condition, "resonatord_reason_code": code}
            self._log.log(logging.WARNING if warn else logging.INFO, form, *values, extra=fields)
