"""Numbers frames without a break, and tells by which cause the missing ones were lost."""

from resonator_daemon.acquisition.clock import Instant
from resonator_daemon.acquisition.frames import FrameLoss, Gap

_HALF_RANGE = 1 << 31


class FrameNumbering:
    """Follows the board's 32-bit frame numbers through wraps, damage, reconnections and reboots.

    Parameters
    ----------
    frame_bytes
        What a whole frame takes on the wire; tells how many of the missing frames arrived damaged.
    gate_ticks, gate_ns
        Length of a gate on the board's clock and on the host's.
    """

    def __init__(self, frame_bytes: int, gate_ticks: int, gate_ns: int) -> None:
        self._frame_bytes = frame_bytes
        self._gate_ticks = gate_ticks
        self._gate_ns = gate_ns
        self._next_index = 0
        self._next_sequence = 0
        self._discarded_bytes = 0
        self._dropped_by_board = 0
        self._dropped_counted = 0
        self._last: tuple[int, int, Instant] | None = None  # boot id, board ticks, gate end
        self._resuming = False

    def started(self) -> None:
        """Take note that the board began to count frames from 0."""
        self._next_sequence = 0
        self._discarded_bytes = 0
        self._dropped_by_board = self._dropped_counted = 0
        self._resuming = self._last is not None

    def discarded(self, size_bytes: int) -> None:
        """Take note of damaged bytes; the next frame tells whether frames were among them."""
        self._discarded_bytes += size_bytes

    def dropped_by_board(self, frames_since_start: int) -> None:
        """Take the board's own count of frames that it could not send."""
        self._dropped_by_board = frames_since_start

    def accept(self, boot_id: int, sequence: int, board_ticks: int, gate_end: Instant) -> tuple[int, Gap | None] | None:
        """Return the frame's index and the gap before it; None for a frame that was there already."""
        missing = (sequence - self._next_sequence) % (2 * _HALF_RANGE)
        if missing >= _HALF_RANGE:
            return None
        loss = self._causes(missing)
        if self._resuming and self._last is not None:
            # The board counted from 0 again: what a run without the outage would have had is told by the clocks.
            last_boot_id, last_ticks, last_end = self._last
            if boot_id == last_boot_id:
                elapsed = (board_ticks - last_ticks) / self._gate_ticks
            else:
                elapsed = (gate_end.utc_ns - last_end.utc_ns) / self._gate_ns
            loss += FrameLoss(link_gap=max(0, round(elapsed) - 1 - missing))
            self._resuming = False
        gap = Gap(self._next_index, loss) if loss.total else None
        index = self._next_index + loss.total
        self._next_index = index + 1
        self._next_sequence = (sequence + 1) % (2 * _HALF_RANGE)
        self._last = (boot_id, board_ticks, gate_end)
        return index, gap

    def _causes(self, missing: int) -> FrameLoss:
        overflow = min(missing, max(0, self._dropped_by_board - self._dropped_counted))
        self._dropped_counted += overflow
        # Fragments too: a frame that arrived in part was damaged, one that never arrived is a gap of the link.
        damaged = min(missing - overflow, -(-self._discarded_bytes // self._frame_bytes))
        self._discarded_bytes = 0
        return FrameLoss(link_gap=missing - overflow - damaged, damaged=damaged, board_overflow=overflow)
