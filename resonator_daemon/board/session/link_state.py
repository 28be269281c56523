"""State of a link: each change is announced once, and each outage when it is over; reasons as codes and sentences."""

import logging
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Final, NamedTuple

from pydantic import BeforeValidator

from firmware_protocol.host import PacketRefusal
from resonator_daemon.base.host.state_log import StateLog
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode, joined
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frames import Arrival, LinkChange, Outage

UNANSWERED_S: Final = 10  # without an answer, though frames come

_OF_PACKETS: Final = {
    "frame_length": ReasonCode.FRAME_LENGTH,
    "frame_part": ReasonCode.FRAME_PART,
    "frame_kind": ReasonCode.FRAME_KIND,
    "frame_ticks": ReasonCode.FRAME_TICKS,
    "message_fields": ReasonCode.MESSAGE_FIELDS,
}

OPENING: Final = Reason(ReasonCode.OPENING, "the link is being opened")


def all_of(reasons: Iterable[Reason]) -> Reason:
    """Return several reasons as one, under the code of the first."""
    return joined(*reasons) or Reason(ReasonCode.UNSPECIFIED, "")


def restarted(cause: str = "") -> Reason:
    """Return the reason of a board that restarted."""
    return Reason(ReasonCode.BOARD_RESTARTED, f"the board restarted{cause}")


def configuring(serial_number: str, firmware: str) -> Reason:
    """Return the reason while a board is being configured."""
    return Reason(ReasonCode.CONFIGURING, f"board {serial_number} with firmware {firmware} is being configured")


def counting(
    serial_number: str,
    frame_rate_hz: float,
    *,
    rate_doubt: str | None,
    is_unanswered: bool,
    refused: PacketRefusal | None,
    busy: Reason | None,
) -> Reason:
    """Return the reason of a link whose frames arrive; its code is that of the last doubt, if there is one."""
    code, sentences = ReasonCode.BOARD_COUNTS, [f"board {serial_number} sends {frame_rate_hz:g} frames/s"]
    if rate_doubt:
        code = ReasonCode.TICK_RATE
        sentences.append(rate_doubt)
    if is_unanswered:
        code = ReasonCode.NO_PONG
        sentences.append(f"no ping was answered for {UNANSWERED_S} s: is the line to the board broken?")
    if refused:
        code, text = _packets_refused(refused)
        sentences.append(text)
    if busy:
        code = busy.code
        sentences.append(busy.text)
    return Reason(code, "; ".join(sentences))


def no_frame(refused: PacketRefusal | None, busy: Reason | None) -> Reason:
    """Return the reason of an open link without frames, with what may explain it."""
    text = "the port is open and no frame comes"
    cause = _packets_refused(refused) if refused is not None else busy
    return Reason(cause.code, f"{text}; {cause.text}") if cause else Reason(ReasonCode.NO_FRAMES, text)


def silence(bytes_received: int, refused: PacketRefusal | None, described: str | None) -> Reason:
    """Return why a handshake came to no end; `described` is the serial number of a board that lacks a pong alone."""
    if refused is not None:
        text = f"no board answers: its packets are refused ({refused.code}): {refused.text}; update its firmware"
        return Reason(_OF_PACKETS[refused.code], text)
    if described is not None:
        text = f"board {described} identifies itself but answers no ping (no_pong); update its firmware"
        return Reason(ReasonCode.NO_PONG, text)
    received = f"{bytes_received} bytes came and no answer" if bytes_received else "not a byte came"
    question = "is it a board of this kind, and the baud rate right?"
    return Reason(ReasonCode.NO_BOARD_ANSWERS, f"no board answers: {received}; {question}")


def _packets_refused(refused: PacketRefusal) -> Reason:
    return Reason(_OF_PACKETS[refused.code], f"packets are refused ({refused.code}): {refused.text}")


def _complete(stored: Any) -> Reason:
    """Return a stored reason with a code that this version has."""
    match stored:
        case str():
            return Reason(ReasonCode.UNSPECIFIED, stored)
        case [str() as code, str() as text]:
            return Reason(ReasonCode(code), text)
    raise ValueError("a reason is [code, text]")


StoredReason = Annotated[Reason, BeforeValidator(_complete)]
"""A reason that is written as [code, text]; a text alone can be read, too."""


_S: Final = 1_000_000_000

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


class RefusalWatch:
    """Most frequent refusal within the last second.

    Parameters
    ----------
    counts
        Number of refused packets by reason, which grow.
    now_ns
        Monotonic time.
    """

    def __init__(self, counts: Mapping[PacketRefusal, int], now_ns: int) -> None:
        self._counts = counts
        self._before: Mapping[PacketRefusal, int] = {}
        self._since_ns = now_ns
        self._last_second: PacketRefusal | None = None

    def update(self, now_ns: int) -> bool:
        """Begin a new second if one is over; return whether the most frequent refusal may have changed."""
        if now_ns - self._since_ns < _S:
            return False
        before, self._last_second = self._last_second, self._most_of_this_second()
        self._before, self._since_ns = dict(self._counts), now_ns
        return before != self._last_second

    @property
    def most_frequent(self) -> PacketRefusal | None:
        """That of the last whole second, else of the present one; None if there is none."""
        return self._last_second or self._most_of_this_second()

    def _most_of_this_second(self) -> PacketRefusal | None:
        added = {refusal: count - self._before.get(refusal, 0) for refusal, count in self._counts.items()}
        most = max(added, key=added.__getitem__, default=None)
        return most if most is not None and added[most] else None
