"""Frames from the wire to the frame queue: assembled, given time and number, and counted."""

from collections.abc import Callable, Sequence
from typing import Final

from firmware_protocol.host import Frame, FramePart, PacketRefusal
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.links.link import LinkLostError
from resonator_daemon.board.session.clock import BoardClock, Instant, TickScale
from resonator_daemon.board.session.compatibility import BoardRefusedError, gate_ticks
from resonator_daemon.board.session.counters import LinkCounters
from resonator_daemon.board.session.frame_assembly import AssembledFrame, FrameAssembler
from resonator_daemon.board.session.frame_numbers import Accepted, BrokenSpacingError, FrameNumbering
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import ChannelisedFrame, SingleToneFrame
from resonator_daemon.board.session.host_time import HostTime

_NOT_IN_PARTS: Final = PacketRefusal("frame_kind", "FRAME came, and the plate needs FRAME_PART")
_IN_PARTS: Final = PacketRefusal("frame_kind", "FRAME_PART came, and the plate needs FRAME")
_TICKS: Final = PacketRefusal("frame_ticks", "board_ticks of a frame are more than 30 s from those of the pings")
_FRAME_AGE_NS = 30_000_000_000  # far beyond what any buffer on the way can hold


class FrameReceiver:
    """Receiver of the frames of one connection; numbering, queue and counters outlive it.

    `assembler` puts parts of frames together. `last_frame_ns` is the monotonic time at which the last frame was
    received, `newest_ticks` the newest tick count in any message of this boot. `refuse` counts frames that cannot be
    received, by reason.
    """

    def __init__(
        self,
        plate: Plate,
        numbering: FrameNumbering,
        queue: FrameQueue,
        counters: LinkCounters,
        refuse: Callable[[PacketRefusal, int], None],
    ) -> None:
        self._refuse = refuse
        self._gate_ticks = gate_ticks(plate)
        self._in_parts = plate.counter.frames_in_parts
        self.assembler = FrameAssembler(len(plate.tones.f0_hz))
        self._numbering = numbering
        self._queue = queue
        self._counters = counters
        self.last_frame_ns = 0
        self.newest_ticks = 0

    def receive_frames(
        self, frames: Sequence[Frame], clock: BoardClock, boot_id: int, now: HostTime
    ) -> list[tuple[Accepted, Instant]]:
        """Receive frames of a single-tone counter that were read together.

        Returns
        -------
        list of tuple
            The frames that do not merely follow the one before them, with the middle of their gates.

        Raises
        ------
        BoardRefusedError
            The board does not keep its gate.
        LinkLostError
            Its clock jumped.
        """
        if self._in_parts:
            self._counters.messages_malformed += len(frames)
            self._refuse(_NOT_IN_PARTS, len(frames))
            return []
        begun = []
        scale, half_gate_ticks = clock.scale, self._gate_ticks // 2
        start, count = 0, len(frames)
        while start < count:
            first = frames[start]
            end = start + 1
            accepted = self._accept(first, scale, boot_id, now)
            if accepted is not None:
                begun.append(accepted)
                end = self._follow(frames, start, scale, now)
                index = accepted[0].index - start
                self._queue.put_frames(
                    [
                        SingleToneFrame(index + at, ticks, ticks - half_gate_ticks, scale, payload)
                        for at, (_, ticks, _, payload) in enumerate(frames[start:end], start)
                    ]
                )
            start = end
        return begun

    def assemble(self, parts: Sequence[FramePart]) -> list[AssembledFrame]:
        """Put parts of channelised frames together; return the frames that are over."""
        if not self._in_parts:
            self._counters.messages_malformed += len(parts)
            self._refuse(_IN_PARTS, len(parts))
            return []
        return self.assembler.add(parts)

    def receive_assembled(
        self, frame: AssembledFrame, scale: TickScale, boot_id: int, now: HostTime
    ) -> tuple[Accepted, Instant] | None:
        """Receive a channelised frame; return its number and the middle of its gate, None where it cannot be.

        Raises
        ------
        BoardRefusedError, LinkLostError
            As of `receive_frames`.
        """
        taken = self._accept(frame, scale, boot_id, now)
        if taken is None:
            return None
        accepted, middle = taken
        self._counters.parts_lost += frame.parts - frame.parts_seen
        self._counters.frames_incomplete += frame.parts_seen < frame.parts
        self._queue.put_frames([ChannelisedFrame(accepted.index, frame.board_ticks, middle, frame.tones)])
        return taken

    def flush(self, clock: BoardClock, boot_id: int, now: HostTime) -> list[tuple[Accepted, Instant]]:
        """Pass on the frame that has begun as it is: no more of it will come. Raises nothing."""
        taken = []
        for frame in self.assembler.flush():
            try:
                taken.append(self.receive_assembled(frame, clock.scale, boot_id, now))
            except (BoardRefusedError, LinkLostError):  # its connection, or its boot, is over anyway
                self._counters.messages_malformed += 1
        return [one for one in taken if one is not None]

    def _follow(self, frames: Sequence[Frame], start: int, scale: TickScale, now: HostTime) -> int:
        """Accept the frames that follow an accepted one gate by gate; return where in `frames` that ends."""
        sequence, ticks, _, _ = frames[start]
        end, gate_ticks = start + 1, self._gate_ticks
        for next_sequence, next_ticks, _, _ in frames[end:]:
            if next_ticks != ticks + gate_ticks or next_sequence != sequence + 1:
                break
            sequence, ticks = next_sequence, next_ticks
            end += 1
        following = end - start - 1
        if not following:
            return end
        middle = scale.at(ticks - gate_ticks // 2)
        if not self._may_be(middle, now):
            return start + 1
        self._numbering.accept_following(following, ticks, middle)
        self._counters.boots[-1].frames += following
        self._counters.frames += following
        self.newest_ticks = max(self.newest_ticks, ticks)
        return end

    def _may_be(self, middle: Instant, now: HostTime) -> bool:
        """Whether this boot has reached the middle of a gate, and no longer ago than a queue may hold."""
        return -_FRAME_AGE_NS < now.monotonic_ns - middle.monotonic_ns < _FRAME_AGE_NS

    def _accept(
        self, frame: Frame | AssembledFrame, scale: TickScale, boot_id: int, now: HostTime
    ) -> tuple[Accepted, Instant] | None:
        """Accept a frame with its number and count it; return None for one that cannot be, or was there before."""
        middle = scale.at(frame.board_ticks - self._gate_ticks // 2)
        if not self._may_be(middle, now):
            self._counters.messages_malformed += 1
            self._refuse(_TICKS, 1)
            return None
        accepted = self._number(frame, boot_id, middle)
        if accepted is None:
            self._counters.messages_stale += 1
            return None
        self.last_frame_ns = now.monotonic_ns
        self.newest_ticks = max(self.newest_ticks, frame.board_ticks)
        boot, gap = self._counters.boots[-1], accepted.gap
        boot.frames += 1
        self._counters.frames += 1
        if gap is not None:
            self._counters.lost += gap.loss
            boot.lost += gap.loss
            self._queue.put(gap)
        return accepted, middle

    def _number(self, frame: Frame | AssembledFrame, boot_id: int, middle: Instant) -> Accepted | None:
        try:
            return self._numbering.accept(boot_id, frame.sequence, frame.board_ticks, middle)
        except BrokenSpacingError as error:
            spacing = f"{error.spacing_ticks} ticks from frame to frame, {error.gate_ticks} were configured"
            if error.from_the_start:
                raise BoardRefusedError(
                    Reason(ReasonCode.WRONG_GATE, f"the board does not keep its gate: {spacing}")
                ) from error
            raise LinkLostError(ReasonCode.CLOCK_JUMPED, f"the board's clock jumped: {spacing}") from error
