"""Puts the parts of a channelised frame together; parts that did not arrive leave their tones unknown."""

from collections.abc import Sequence
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
    """The parts of one frame that arrived, and where in its records they belong."""

    sequence: int
    board_ticks: int
    parts: int
    blank: bytes  # records of a frame of which nothing arrived
    pieces: dict[int, memoryview] = field(default_factory=dict)  # by their first byte
    seen: set[int] = field(default_factory=set)
    size_bytes: int = 0

    @property
    def parts_seen(self) -> int:
        return len(self.seen)

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


def known_tones(tones: Tones) -> NDArray[np.bool_]:
    """Return which records hold a usable frequency; shape as `tones`."""
    flags: NDArray[np.uint8] = tones["flags"]
    known: NDArray[np.bool_] = (flags & _UNUSABLE) == 0
    return known


def variance_of(tones: Tones) -> NDArray[np.float64]:
    """Return the variance of each record's offset in Hz^2, infinite where it is not usable; shape as `tones`."""
    codes = tones.view("<u2").reshape(*tones.shape, -1)[..., -1]  # sigma_code, and flags as the upper byte
    return np.take(_VARIANCE_HZ2, codes, mode="clip")


def _variances() -> NDArray[np.float64]:
    by_sigma_code = np.exp2((np.arange(256) - 128) / 8) ** 2
    return np.where((np.arange(256) & _UNUSABLE)[:, None], np.inf, by_sigma_code).ravel()


_VARIANCE_HZ2 = _variances()


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
    def begun(self) -> bool:
        """Whether parts of a frame are here and others are to come."""
        return self._open is not None

    def add(self, parts: Sequence[FramePart]) -> list[AssembledFrame]:
        """Copy parts to where they belong; return the frames that are over: complete, or followed by a later one."""
        done = []
        frame = self._open
        all_tones, tone_bytes = self._tones, TONE_STRUCT.size
        for part in parts:
            sequence, _, size_bytes, (channel, _, first_tone, tones, number, _), data = part
            if frame is None or sequence != frame.sequence:
                if frame is not None:
                    done.append(frame)
                frame = self._begin(part)
            seen = frame.seen
            if first_tone + tones > all_tones or number in seen:
                self.unplaced_parts += 1
                continue
            start = (channel * all_tones + first_tone) * tone_bytes
            frame.pieces[start] = data
            seen.add(number)
            frame.size_bytes += size_bytes
            if len(seen) >= frame.parts:
                done.append(frame)
                frame = None
        self._open = frame
        return done

    def flush(self) -> list[AssembledFrame]:
        """Return the frame that was begun, as when the link is lost."""
        frame, self._open = self._open, None
        return [frame] if frame else []

    def _begin(self, part: FramePart) -> AssembledFrame:
        return AssembledFrame(part.sequence, part.board_ticks, part.block.parts, self._blank)
