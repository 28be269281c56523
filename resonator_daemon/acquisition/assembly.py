"""Puts the parts of a channelised frame together; parts that did not arrive leave their tones unknown."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.host import FramePart
from firmware_protocol.layouts import CHANNEL_COUNT, TONE_FIELDS, TONE_STRUCT, ToneFlag

Tones = NDArray[np.void]
TONE = np.dtype([(field.name, "<" + field.code) for field in TONE_FIELDS])
_UNUSABLE = ToneFlag.NO_SIGNAL | ToneFlag.SATURATED | ToneFlag.OUT_OF_BAND
_BLANK = TONE_STRUCT.pack(0, 0, 0, 0, ToneFlag.NO_SIGNAL)


@dataclass(slots=True)
class AssembledFrame:
    """Tones (4, tones) as records of the wire; those that did not arrive have no signal."""

    sequence: int
    board_ticks: int
    parts: int
    records: bytearray
    tones: Tones
    seen: set[int] = field(default_factory=set)
    size_bytes: int = 0

    @property
    def parts_seen(self) -> int:
        return len(self.seen)


def known_tones(tones: Tones) -> NDArray[np.bool_]:
    """Return which records hold a usable frequency; shape as `tones`."""
    flags: NDArray[np.uint8] = tones["flags"]
    known: NDArray[np.bool_] = (flags & _UNUSABLE) == 0
    return known


class FrameAssembler:
    """Collects parts until a frame is complete, or a later frame begins.

    Parameters
    ----------
    tones
        Tones on each channel; parts that reach beyond, and repeated ones, are refused and counted in `misfits`.
    """

    def __init__(self, tones: int) -> None:
        self._tones = tones
        self._blank = _BLANK * (CHANNEL_COUNT * tones)
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
        records = bytearray(self._blank)
        tones = np.frombuffer(records, TONE).reshape(CHANNEL_COUNT, self._tones)
        return AssembledFrame(part.sequence, part.board_ticks, part.block.parts, records, tones)

    def _fill(self, frame: AssembledFrame, part: FramePart) -> None:
        channel, _, first_tone, tones, number, _ = part.block
        if first_tone + tones > self._tones or number in frame.seen:
            self.misfits += 1
            return
        start = (channel * self._tones + first_tone) * TONE_STRUCT.size
        frame.records[start : start + len(part.tones)] = part.tones
        frame.seen.add(number)
        frame.size_bytes += part.size_bytes
