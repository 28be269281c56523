"""Frames from the wire to the frame queue: put together of their parts, given time and number, and counted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from firmware_protocol.host import Frame, FramePart, PacketRefusal
from firmware_protocol.layouts import CHANNEL_COUNT, TONE_STRUCT, ToneFlag
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.links.link import LinkLostError
from resonator_daemon.board.session.clock import HostTime, Instant, TickScale
from resonator_daemon.board.session.compatibility import BoardRefusedError, gate_ticks
from resonator_daemon.board.session.frame_numbers import Accepted, BrokenSpacingError, FrameNumbering
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import TONE, ChannelisedFrame, LinkCounters, SingleToneFrame, Tones

_NOT_IN_PARTS: Final = PacketRefusal("frame_kind", "FRAME came, and the plate needs FRAME_PART")
_IN_PARTS: Final = PacketRefusal("frame_kind", "FRAME_PART came, and the plate needs FRAME")
_TICKS: Final = PacketRefusal("frame_ticks", "board_ticks of a frame are more than 30 s from those of the pings")
_FRAME_AGE_NS = 30_000_000_000  # far beyond what any buffer on the way can hold
_BLANK = TONE_STRUCT.pack(0, 0, 0, 0, ToneFlag.NO_SIGNAL)


@dataclass(slots=True)
class AssembledFrame:
    """The parts of one frame that arrived, and where in its records they belong."""

    sequence: int
    board_ticks: int
    parts: int
    blank: bytes  # records of a frame of which nothing arrived
    pieces: dict[int, memoryview] = field(default_factory=dict)  # by their first byte
    seen: set[int] = field(default_factory=set)

    @property
    def tones(self) -> Tones:
        """Tones (4, tones) as records of the wire; those that did not arrive have no signal."""
        end = 0
        for start, piece in self.pieces.items():
            if start != end:
                break
            end += len(piece)
        if end == len(self.blank):
            records: bytes | bytearray = b"".join(self.pieces.values())
        else:
            records = bytearray(self.blank)
            for start, piece in self.pieces.items():
                records[start : start + len(piece)] = piece
        return np.frombuffer(records, TONE).reshape(CHANNEL_COUNT, -1)


class FrameAssembler:
    """Collects parts until a frame is complete, or a later frame begins.

    Parameters
    ----------
    tones
        Tones on each channel; parts that reach beyond, and repeated ones, are refused and counted in `unplaced_parts`.
    """

    def __init__(self, tones: int) -> None:
        self._tones = tones
        self._blank = _BLANK * (CHANNEL_COUNT * tones)
        self._open: AssembledFrame | None = None
        self.unplaced_parts = 0

    @property
    def has_partial_frame(self) -> bool:
        """Whether parts of a frame are here and others are to come."""
        return self._open is not None

    def add(self, parts: Sequence[FramePart]) -> list[AssembledFrame]:
        """Copy parts to where they belong; return the frames that are over: complete, or followed by a later one."""
        done = []
        frame = self._open
        all_tones, tone_bytes = self._tones, TONE_STRUCT.size
        for sequence, board_ticks, _, (channel, _, first_tone, tones, number, parts_of_frame), data in parts:
            if frame is None or sequence != frame.sequence:
                if frame is not None:
                    done.append(frame)
                frame = AssembledFrame(sequence, board_ticks, parts_of_frame, self._blank)
            seen = frame.seen
            if first_tone + tones > all_tones or number in seen:
                self.unplaced_parts += 1
                continue
            frame.pieces[(channel * all_tones + first_tone) * tone_bytes] = data
            seen.add(number)
            if len(seen) >= frame.parts:
                done.append(frame)
                frame = None
        self._open = frame
        return done

    def flush(self) -> list[AssembledFrame]:
        """Return the frame that has begun, as when the link is lost."""
        frame, self._open = self._open, None
        return [frame] if frame else []


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

    def assemble(self, parts: Sequence[FramePart]) -> list[AssembledFrame]:
        """Put parts of channelised frames together; return the frames that are over."""
        if self._in_parts:
            return self.assembler.add(parts)
        self._refuse_kind(_IN_PARTS, len(parts))
        return []

    def receive(
        self,
        frames: Sequence[Frame | AssembledFrame],
        scale: TickScale,
        boot_id: int,
        now: HostTime,
        *,
        singly: bool = False,
    ) -> list[Accepted]:
        """Receive frames that were read together: count them, and put them into the queue with number and time.

        Returns
        -------
        list of Accepted
            The frames that do not merely follow the one before them; all of them if `singly`.

        Raises
        ------
        BoardRefusedError
            The board does not keep its gate.
        LinkLostError
            Its clock jumped.
        """
        if self._in_parts and frames and isinstance(frames[0], Frame):
            self._refuse_kind(_NOT_IN_PARTS, len(frames))
            return []
        begun = []
        start, half_gate_ticks = 0, self._gate_ticks // 2
        while start < len(frames):
            count = 0 if singly else self._numbering.count_following(frames, start)
            if count:
                ticks = frames[start + count - 1].board_ticks
                middle = scale.at(ticks - half_gate_ticks)
                if not -_FRAME_AGE_NS < now.monotonic_ns - middle.monotonic_ns < _FRAME_AGE_NS:
                    count = 0
            if count:
                self._numbering.accept_following(count, ticks, middle)
                index = self._numbering.next_index - count
            else:
                accepted = self._accept(frames[start], scale, boot_id, now)
                if accepted is None:
                    start += 1
                    continue
                begun.append(accepted)
                index, count, ticks, middle = accepted.index, 1, frames[start].board_ticks, accepted.middle
            self.last_frame_ns = now.monotonic_ns
            if ticks > self.newest_ticks:
                self.newest_ticks = ticks
            self._counters.boots[-1].frames += count
            self._counters.frames += count
            self._put(frames[start : start + count], index, scale, middle)
            start += count
        return begun

    def flush(self, scale: TickScale, boot_id: int, now: HostTime) -> list[Accepted]:
        """Pass on the frame that has begun as it is: no more of it will come. Raises nothing."""
        try:
            return self.receive(self.assembler.flush(), scale, boot_id, now)
        except (BoardRefusedError, LinkLostError):  # its connection, or its boot, is over anyway
            self._counters.messages_malformed += 1
            return []

    def _put(self, frames: Sequence[Frame | AssembledFrame], index: int, scale: TickScale, middle: Instant) -> None:
        """Put adjacent frames into the queue; `middle` is that of the last gate."""
        half_gate_ticks = self._gate_ticks // 2
        made: list[SingleToneFrame | ChannelisedFrame] = []
        for frame in frames:
            number, ticks = index + len(made), frame.board_ticks
            if isinstance(frame, Frame):
                made.append(SingleToneFrame(number, ticks, ticks - half_gate_ticks, scale, frame.payload))
                continue
            own = middle if frame is frames[-1] else scale.at(ticks - half_gate_ticks)
            made.append(ChannelisedFrame(number, ticks, own, frame.tones))
            if len(frame.seen) < frame.parts:
                self._counters.parts_lost += frame.parts - len(frame.seen)
        self._queue.put_frames(made, middle)

    def _accept(self, frame: Frame | AssembledFrame, scale: TickScale, boot_id: int, now: HostTime) -> Accepted | None:
        """Accept a frame with its number and count the gap before it; None for one that cannot be, or was there."""
        middle = scale.at(frame.board_ticks - self._gate_ticks // 2)
        if not -_FRAME_AGE_NS < now.monotonic_ns - middle.monotonic_ns < _FRAME_AGE_NS:
            self._refuse_kind(_TICKS, 1)
            return None
        try:
            accepted = self._numbering.accept(boot_id, frame.sequence, frame.board_ticks, middle)
        except BrokenSpacingError as error:
            spacing = f"{error.spacing_ticks} ticks from frame to frame, {error.gate_ticks} were configured"
            if error.from_the_start:
                wrong_gate = Reason(ReasonCode.WRONG_GATE, f"the board does not keep its gate: {spacing}")
                raise BoardRefusedError(wrong_gate) from error
            raise LinkLostError(ReasonCode.CLOCK_JUMPED, f"the board's clock jumped: {spacing}") from error
        if accepted is None:
            self._counters.messages_stale += 1
            return None
        if (gap := accepted.gap) is not None:
            boot = self._counters.boots[-1]
            self._counters.lost += gap.loss
            boot.lost += gap.loss
            self._queue.put(gap)
        return accepted

    def _refuse_kind(self, refusal: PacketRefusal, count: int) -> None:
        self._counters.messages_malformed += count
        self._refuse(refusal, count)
