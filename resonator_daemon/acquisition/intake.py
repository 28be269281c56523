"""Frames from the wire to the ring: put together, given their time and number, and booked."""

from firmware_protocol.host import Frame, FramePart
from resonator_daemon.acquisition.account import LinkAccount
from resonator_daemon.acquisition.assembly import AssembledFrame, FrameAssembler
from resonator_daemon.acquisition.clock import BoardClock, Instant
from resonator_daemon.acquisition.fit import BoardRefusedError, gate_ticks
from resonator_daemon.acquisition.frames import ChannelisedFrame, SingleToneFrame
from resonator_daemon.acquisition.host_time import HostTime
from resonator_daemon.acquisition.link import LinkLostError
from resonator_daemon.acquisition.numbering import Accepted, BrokenSpacingError, FrameNumbering
from resonator_daemon.acquisition.ring import Ring
from resonator_daemon.plate import Plate

_FRAME_AGE_NS = 30_000_000_000  # far beyond what any buffer on the way can hold


class FrameIntake:
    """Takes the frames of one connection; the numbers, the ring and the account outlive it.

    `last_frame_ns` is the monotonic time at which a frame was taken last, `newest_ticks` the newest tick count that any
    message of this boot has told.
    """

    def __init__(self, plate: Plate, numbering: FrameNumbering, ring: Ring, account: LinkAccount) -> None:
        self._gate_ticks = gate_ticks(plate)
        self._single_tone = plate.counter.kind == "single-tone"
        self._assembler = FrameAssembler(len(plate.tones.f0_hz))
        self._numbering = numbering
        self._ring = ring
        self._account = account
        self.last_frame_ns = 0
        self.newest_ticks = 0

    @property
    def misfits(self) -> int:
        """Parts of frames that had no place in theirs."""
        return self._assembler.misfits

    @property
    def frame_begun(self) -> bool:
        """Whether a frame has come in part."""
        return self._assembler.begun

    def take(
        self, event: Frame | FramePart, clock: BoardClock, boot_id: int, now: HostTime
    ) -> list[tuple[Accepted, Instant]]:
        """Take what came; return which frames are complete now, with the middle of their gates.

        Raises
        ------
        BoardRefusedError
            The board does not keep its gate.
        LinkLostError
            Its clock jumped.
        """
        match event:
            case Frame() if self._single_tone:
                whole = self._put(event, clock, boot_id, now)
                return [] if whole is None else [whole]
            case FramePart() if not self._single_tone:
                frames = self._assembler.add(event)
                return [taken for frame in frames if (taken := self._put(frame, clock, boot_id, now)) is not None]
            case _:
                self._account.messages_malformed += 1  # of the other kind of counter
                return []

    def flush(self, clock: BoardClock, boot_id: int, now: HostTime) -> list[tuple[Accepted, Instant]]:
        """Take the frame that has begun as it is: no more of it will come. Raises nothing."""
        taken = []
        for frame in self._assembler.flush():
            try:
                taken.append(self._put(frame, clock, boot_id, now))
            except (BoardRefusedError, LinkLostError):  # its connection, or its boot, is over anyway
                self._account.messages_malformed += 1
        return [one for one in taken if one is not None]

    def _put(
        self, frame: Frame | AssembledFrame, clock: BoardClock, boot_id: int, now: HostTime
    ) -> tuple[Accepted, Instant] | None:
        middle = clock.at(frame.board_ticks - self._gate_ticks // 2)
        if not -_FRAME_AGE_NS < now.monotonic_ns - middle.monotonic_ns < _FRAME_AGE_NS:
            self._account.messages_malformed += 1  # ticks that this boot has not reached, or long left behind
            return None
        accepted = self._number(frame, boot_id, middle)
        if accepted is None:
            self._account.messages_stale += 1
            return None
        self.last_frame_ns = now.monotonic_ns
        if frame.board_ticks > self.newest_ticks:
            self.newest_ticks = frame.board_ticks
        boot, gap = self._account.boots[-1], accepted.gap
        boot.frames += 1
        self._account.frames += 1
        if gap is not None:
            self._account.lost += gap.loss
            boot.lost += gap.loss
            self._ring.put(gap)
        if isinstance(frame, Frame):
            self._ring.put_frame(SingleToneFrame(accepted.index, frame.board_ticks, middle, frame.payload))
        else:
            self._account.parts_lost += frame.parts - frame.parts_seen
            self._account.frames_incomplete += frame.parts_seen < frame.parts
            self._ring.put_frame(
                ChannelisedFrame(
                    accepted.index,
                    frame.board_ticks,
                    middle,
                    frame.phase_turn32,
                    frame.offset_hz16,
                    frame.sigma_code,
                    frame.known,
                )
            )
        return accepted, middle

    def _number(self, frame: Frame | AssembledFrame, boot_id: int, middle: Instant) -> Accepted | None:
        try:
            return self._numbering.accept(boot_id, frame.sequence, frame.board_ticks, middle)
        except BrokenSpacingError as error:
            spacing = f"{error.spacing_ticks} ticks from frame to frame, {error.gate_ticks} were configured"
            if error.from_the_start:
                raise BoardRefusedError(f"the board does not keep its gate: {spacing}") from error
            raise LinkLostError(f"the board's clock jumped: {spacing}") from error
