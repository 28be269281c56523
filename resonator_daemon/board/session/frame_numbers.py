"""Numbering of frames without a break, and attribution of the missing ones to a cause."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frames import FrameLoss, Gap

_HALF_RANGE, _RANGE = 1 << 31, 1 << 32
_QUEUED_NS = 30_000_000_000  # far beyond what any queue on the way can hold
_SETTLED_FRAMES = 2  # from the second on, their spacing has been looked at
_NOTHING_LOST = FrameLoss()
_CLOCKS_AGREE = 5e-4  # share of an outage by which ticks and the host's clock may differ: rates, and their drift


@dataclass(slots=True)  # one for each frame: frozen ones take three times as long to make
class Accepted:
    """A frame's number, the middle of its gate, the gap before it, and the time of the frame before that gap."""

    index: int
    middle: Instant
    gap: Gap | None
    previous: Instant | None


class NumberedFrame(Protocol):
    """A frame as the board numbers it."""

    @property
    def sequence(self) -> int: ...

    @property
    def board_ticks(self) -> int: ...


class NumberingSnapshot(NamedTuple):
    """State of `FrameNumbering`; `last`: boot id, board ticks and time of the last frame.

    `unexplained`: frames counted as link_gap and as damaged since the board's last report.
    """

    next_index: int
    next_sequence: int
    dropped_by_board: int
    last: tuple[int, int, Instant] | None
    unexplained: tuple[int, int] = (0, 0)


class BrokenSpacingError(Exception):
    """Frames of one run do not lie a gate apart: the board's ticks jumped, or its gate is not the one configured."""

    def __init__(self, spacing_ticks: int, gate_ticks: int, *, from_the_start: bool) -> None:
        super().__init__(spacing_ticks, gate_ticks)
        self.spacing_ticks = spacing_ticks
        self.gate_ticks = gate_ticks
        self.from_the_start = from_the_start


class FrameNumbering:
    """Follows the board's 32-bit frame numbers through wraps, damage, reconnections and reboots.

    Parameters
    ----------
    frame_bytes
        Size of a whole frame on the wire, by which discarded bytes are counted as damaged frames.
    gate_ticks, gate_ns
        Length of a gate on the board's clock and on the host's.

    Attributes
    ----------
    next_index
        Index of the next frame that follows without a gap.
    """

    def __init__(self, frame_bytes: int, gate_ticks: int, gate_ns: int) -> None:
        self._frame_bytes = frame_bytes
        self._gate_ticks = gate_ticks
        self._gate_ns = gate_ns
        self.next_index = 0
        self._next_sequence = 0
        self._discarded_bytes = 0
        self._dropped_by_board = 0
        self._dropped_counted = 0
        self._unexplained = (0, 0)
        self._overrun = False
        self._last: tuple[int, int, Instant] | None = None  # boot id, board ticks, time
        self._frames_of_run = 0
        self._started_ns = 0
        self._resuming = False

    def started(self, now_monotonic_ns: int) -> None:
        """Begin a run: the board numbers frames from 0."""
        self._started_ns = now_monotonic_ns
        self._next_sequence = 0
        self._discarded_bytes = 0
        self._dropped_by_board = self._dropped_counted = 0
        self._unexplained = (0, 0)
        self._overrun = False
        self._frames_of_run = 0
        self._resuming = self._last is not None

    @property
    def settled(self) -> bool:
        """Whether a run is well under way, and no loss waits for the next frame to be counted."""
        undecided = self._discarded_bytes or self._overrun or self._dropped_by_board != self._dropped_counted
        return self._frames_of_run >= _SETTLED_FRAMES and not undecided

    def snapshot(self) -> NumberingSnapshot:
        """Return the state; within a run only while `settled`."""
        return NumberingSnapshot(
            self.next_index, self._next_sequence, self._dropped_by_board, self._last, self._unexplained
        )

    def restore(self, snapshot: NumberingSnapshot) -> None:
        self.next_index, self._next_sequence, self._dropped_by_board, self._last, self._unexplained = snapshot
        self._dropped_counted = self._dropped_by_board
        self._discarded_bytes, self._overrun, self._resuming = 0, False, False
        self._frames_of_run = _SETTLED_FRAMES

    def discarded(self, size_bytes: int) -> None:
        """Add damaged bytes; the next frame shows whether frames were among them."""
        self._discarded_bytes += size_bytes

    def dropped_by_board(self, frames_since_start: int) -> None:
        """Set the board's own count of frames that it could not send before the next one."""
        self._dropped_by_board = max(frames_since_start, self._dropped_by_board)
        if self._dropped_by_board == self._dropped_counted:
            self._unexplained = (0, 0)

    def overrun(self) -> None:
        """Note a loss by the host's driver; the next frame shows whether frames were among it."""
        self._overrun = True

    def continues(self, boot_id: int, board_ticks: int) -> bool:
        """Return whether a tick count may belong to the same time line as the last frame's."""
        return self._last is not None and self._last[0] == boot_id and board_ticks >= self._last[1]

    def accept(self, boot_id: int, sequence: int, board_ticks: int, time: Instant) -> Accepted | None:
        """Return the frame's index and the gap before it; None for a frame that was there already or cannot be yet.

        Raises
        ------
        BrokenSpacingError
            When its ticks are not where its number puts them; nothing has been counted then.
        """
        missing = (sequence - self._next_sequence) % _RANGE
        if missing >= _HALF_RANGE or self._cannot_be_missing(missing, time):
            return None
        self._check_spacing(missing, board_ticks)
        previous = self._last[2] if self._last is not None else None
        index, gap = self.next_index, None
        if missing or not self.settled:
            loss = self._causes(missing)
            if self._resuming:
                loss += FrameLoss(link_gap=max(0, self._gates_away(boot_id, board_ticks, time) - 1 - missing))
                self._resuming = False
            if loss != _NOTHING_LOST:
                gap = Gap(index, loss)
                index += loss.total
        self.next_index = index + 1
        self._next_sequence = (sequence + 1) % _RANGE
        self._last = (boot_id, board_ticks, time)
        self._frames_of_run += 1
        return Accepted(index, time, gap, previous)

    def count_following(self, frames: Sequence[NumberedFrame], start: int) -> int:
        """Return how many frames from `start` on follow the last one without a break, and without a loss to count."""
        undecided = self._discarded_bytes or self._overrun or self._dropped_by_board != self._dropped_counted
        if undecided or not self._frames_of_run or self._last is None:
            return 0
        sequence, ticks, gate_ticks = self._next_sequence, self._last[1], self._gate_ticks
        for at in range(start, len(frames)):
            frame = frames[at]
            ticks += gate_ticks
            if frame.sequence != sequence or frame.board_ticks != ticks:
                return at - start
            sequence = (sequence + 1) % _RANGE
        return len(frames) - start

    def accept_following(self, count: int, board_ticks: int, time: Instant) -> None:
        """Accept `count` frames, the last with these ticks, that follow the one before without a break."""
        if self._last is None:
            raise ValueError("frames follow an accepted one of their run")
        self.next_index += count
        self._next_sequence = (self._next_sequence + count) % _RANGE
        self._last = (self._last[0], board_ticks, time)
        self._frames_of_run += count

    def _cannot_be_missing(self, missing: int, time: Instant) -> bool:
        """Return whether a run has not had the time for as many frames before its first."""
        return not self._frames_of_run and missing * self._gate_ns > time.monotonic_ns - self._started_ns + _QUEUED_NS

    def _check_spacing(self, missing: int, board_ticks: int) -> None:
        if self._frames_of_run and self._last is not None:
            spacing_ticks = board_ticks - self._last[1]
            if spacing_ticks != (missing + 1) * self._gate_ticks:
                raise BrokenSpacingError(
                    spacing_ticks // (missing + 1), self._gate_ticks, from_the_start=self._frames_of_run == 1
                )

    def _gates_away(self, boot_id: int, board_ticks: int, time: Instant) -> int:
        """Return how many gates an uninterrupted run would have had since the last frame."""
        if self._last is None:
            return 0
        last_boot_id, last_ticks, last_time = self._last
        by_board = (board_ticks - last_ticks) / self._gate_ticks
        by_host = (time.boottime_ns - last_time.boottime_ns) / self._gate_ns  # counts on while the host sleeps
        unsure = 1 + (last_time.uncertainty_ns + time.uncertainty_ns) / self._gate_ns
        # The board's ticks are exact if they went on through the outage. The same boot id does not prove that: it may
        # come twice. A clock that agrees does.
        agrees = abs(by_board - by_host) < unsure + _CLOCKS_AGREE * abs(by_host)
        return round(by_board if boot_id == last_boot_id and agrees else by_host)

    def _causes(self, missing: int) -> FrameLoss:
        reported = self._dropped_by_board - self._dropped_counted
        overflow = min(missing, reported)
        self._dropped_counted = self._dropped_by_board  # its report ends with this frame
        correction = self._correction(reported - overflow)
        if reported:
            self._unexplained = (0, 0)
        left = missing - overflow
        # Fragments too: a frame that arrived in part was damaged, one that never arrived is a gap of the link.
        damaged = min(left, -(-self._discarded_bytes // self._frame_bytes))
        overrun = self._overrun
        self._discarded_bytes, self._overrun = 0, False
        if overrun:
            return FrameLoss(host_overrun=left, board_overflow=overflow) + correction
        link_gap, damaged_before = self._unexplained
        self._unexplained = (link_gap + left - damaged, damaged_before + damaged)
        return FrameLoss(link_gap=left - damaged, damaged=damaged, board_overflow=overflow) + correction

    def _correction(self, dropped_before: int) -> FrameLoss:
        """Return what attributes earlier losses to the board, whose report of them had been lost; its sum is 0."""
        link_gap = min(dropped_before, self._unexplained[0])
        damaged = min(dropped_before - link_gap, self._unexplained[1])
        return FrameLoss(link_gap=-link_gap, damaged=-damaged, board_overflow=link_gap + damaged)
