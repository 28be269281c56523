"""Puts the parts of a channelised frame together; parts that did not arrive leave their tones unknown."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.host import FramePart
from firmware_protocol.layouts import CHANNEL_COUNT, TONE_FIELDS, ToneFlag

_TONE = np.dtype([(field.name, "<" + field.code) for field in TONE_FIELDS])
_UNUSABLE = ToneFlag.NO_SIGNAL | ToneFlag.SATURATED | ToneFlag.OUT_OF_BAND


@dataclass(slots=True)
class AssembledFrame:
    """Arrays (4, tones) in the wire's units and what is known of them."""

    sequence: int
    board_ticks: int
    parts: int
    phase_turn32: NDArray[np.int32]
    offset_hz16: NDArray[np.int32]
    sigma_code: NDArray[np.uint8]
    known: NDArray[np.bool_]
    seen: set[int] = field(default_factory=set)
    size_bytes: int = 0

    @property
    def parts_seen(self) -> int:
        return len(self.seen)


class FrameAssembler:
    """Collects parts until a frame is complete, or a later frame begins.

    Parameters
    ----------
    tones
        Tones on each channel; parts that reach beyond, and repeated ones, are refused and counted in `misfits`.
    """

    def __init__(self, tones: int) -> None:
        self._tones = tones
        self._open: AssembledFrame | None = None
        self.misfits = 0

    @property
    def begun(self) -> bool:
        """Whether parts of a frame are here and others are to come."""
        return self._open is not None

    def add(self, part: FramePart) -> list[AssembledFrame]:
        """Take a part; return the frames that are over: an incomplete one before it, its own if now complete."""
        done = []
        frame = self._open
        if frame is not None and part.sequence != frame.sequence:
            done.append(frame)
            frame = None
        if frame is None:
            frame = self._open = self._begin(part)
        self._fill(frame, part)
        if frame.parts_seen >= frame.parts:
            done.append(frame)
            self._open = None
        return done

    def flush(self) -> list[AssembledFrame]:
        """Return the frame that was begun, as when the link is lost."""
        frame, self._open = self._open, None
        return [frame] if frame else []

    def _begin(self, part: FramePart) -> AssembledFrame:
        shape = (CHANNEL_COUNT, self._tones)
        return AssembledFrame(
            sequence=part.sequence,
            board_ticks=part.board_ticks,
            parts=part.block.parts,
            phase_turn32=np.zeros(shape, np.int32),
            offset_hz16=np.zeros(shape, np.int32),
            sigma_code=np.zeros(shape, np.uint8),
            known=np.zeros(shape, np.bool_),
        )

    def _fill(self, frame: AssembledFrame, part: FramePart) -> None:
        block = part.block
        end = block.first_tone + block.tones
        if end > self._tones or block.part in frame.seen:
            self.misfits += 1
            return
        tones = np.frombuffer(part.tones, _TONE)
        where = (block.channel, slice(block.first_tone, end))
        frame.phase_turn32[where] = tones["phase_turn32"]
        frame.offset_hz16[where] = tones["offset_hz16"]
        frame.sigma_code[where] = tones["sigma_code"]
        frame.known[where] = (tones["flags"] & _UNUSABLE) == 0
        frame.seen.add(block.part)
        frame.size_bytes += part.size_bytes
