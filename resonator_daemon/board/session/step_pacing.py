"""When the reader looks at the link: once per step of frames, instead of once per frame."""

from collections.abc import Sequence
from typing import Final

_EARLY_NS: Final = 15_000  # by which the lag grows after a read that came too early
_RIGHT_NS: Final = 3_000  # by which it shrinks after a read that found the whole step
_LAG_MAX_NS: Final = 500_000
_SLEEP_MAX_NS: Final = 5_500_000
_SLEEP_BYTES_MAX: Final = 2048  # half of what a pseudo-terminal holds


class StepPacing:
    """Predicts when the last frame of a step can be read.

    A frame can be read some time after the end of its gate: the lag of board, link and kernel. The lag is estimated
    from the outcome of earlier reads, so that about one read in six comes too early. Such a read then waits for the
    rest of the step, at no delay. A lag that few frames exceed would delay all others.

    Parameters
    ----------
    frame_bytes
        Size of a frame on the wire.
    frame_ns
        Time from frame to frame.

    Attributes
    ----------
    small_frames
        Whether the link's buffers hold more than a frame; for others, nothing is predicted.
    awaited_index
        Index of the frame that the next read should find; None if none is predicted.
    """

    def __init__(self, frame_bytes: int, frame_ns: int) -> None:
        self._frame_ns = frame_ns
        self._sleep_max_ns = min(_SLEEP_MAX_NS, _SLEEP_BYTES_MAX * frame_ns // frame_bytes)
        self.small_frames = self._sleep_max_ns > frame_ns
        self._lag_ns = 0
        self.awaited_index: int | None = None

    def sleep_ns(
        self, now_ns: int, newest_index: int, newest_middle_ns: int, step_frames: Sequence[int], limit_ns: int
    ) -> int:
        """Return how long to wait before the next read, at most as long as the link's buffers hold.

        Parameters
        ----------
        now_ns
            Monotonic time of the host.
        newest_index, newest_middle_ns
            Of the last frame that was read: index, and the middle of its gate by the monotonic clock.
        step_frames
            Frames whose index, counted from 1, is a multiple of any of these numbers complete a step.
        limit_ns
            Monotonic time at which the reader has something else to do.
        """
        self.awaited_index = None
        count = newest_index + 1
        frames = step_frames[0] - count % step_frames[0]
        for step in step_frames[1:]:
            frames = min(frames, step - count % step)
        end_ns = newest_middle_ns + self._frame_ns * frames + self._frame_ns // 2
        wait_ns = end_ns + self._lag_ns - now_ns
        longest_ns = min(limit_ns - now_ns, self._sleep_max_ns)
        if wait_ns <= longest_ns:
            self.awaited_index = newest_index + frames
        return max(0, min(wait_ns, longest_ns))

    def has_read(self, newest_index: int) -> None:
        """Correct the lag by the outcome of the read after `sleep_ns`."""
        if self.awaited_index is not None:
            lag_ns = self._lag_ns + _EARLY_NS if newest_index < self.awaited_index else self._lag_ns - _RIGHT_NS
            self._lag_ns = min(max(lag_ns, 0), _LAG_MAX_NS)
            self.awaited_index = None
