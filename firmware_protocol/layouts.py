"""The wire's numbers: message types, record layouts and field tables, as data.

`struct` (here) and numpy (in the packages that may use it) read the same tables, so that no format is written twice.
"""

import struct
from enum import IntEnum, IntFlag
from functools import partial
from typing import NamedTuple

PROTOCOL_MAJOR = 1
PROTOCOL_MINOR = 0

CHANNEL_COUNT = 4  # one transducer per corner


class MessageType(IntEnum):
    """Third byte of every packet; bit 7 is the direction, so that an echo is recognised."""

    IDENTIFY = 0x01
    DESCRIBE = 0x02
    CONFIGURE = 0x03
    START = 0x04
    STOP = 0x05
    PING = 0x06
    LOCATE = 0x07
    IDENTITY = 0x81
    DESCRIPTION = 0x82
    CONFIGURED = 0x83
    STARTED = 0x84
    STOPPED = 0x85
    PONG = 0x86
    LOCATED = 0x87
    FRAME = 0x90
    FRAME_PART = 0x91
    STATUS = 0x92
    LOG = 0x93
    REFUSED = 0x9F


FROM_BOARD = 0x80  # set in the type of every message that a board sends


class Capability(IntFlag):
    """What a board can do beyond what every board can; part of DESCRIPTION."""

    TEMPERATURE = 0x01  # STATUS carries temperature_millikelvin
    LOCATE = 0x02


class RecordFlag(IntFlag):
    """Condition of one single-tone reading."""

    LOST_EDGE = 0x0001
    OVERFLOW = 0x0002
    SATURATED = 0x0004
    CAPTURE_SWITCH = 0x0008  # the loop followed another tone during this gate
    NO_SIGNAL = 0x0010
    STRIDE_BREAK = 0x0020  # stamps do not continue the stride of the frame before


class ToneFlag(IntFlag):
    """Condition of one tone of a channelised counter on one channel."""

    NO_SIGNAL = 0x01
    SATURATED = 0x02
    OUT_OF_BAND = 0x04


class Field(NamedTuple):
    """One little-endian integer of a record: its name with unit, and its struct code."""

    name: str
    code: str


def struct_of(fields: tuple[Field, ...]) -> struct.Struct:
    return struct.Struct("<" + "".join(field.code for field in fields))


class SingleToneRecord(NamedTuple):
    """One captured tone on one channel in one gate: exact sums over the time stamps t_k, k = 0..stamps-1.

    The stamps are of every stride-th edge. s1 = sum(t_k - t_0), s2 = sum(k (t_k - t_0)),
    q2 = sum((t_k - 2 t_(k-1) + t_(k-2))^2).
    """

    first_edge: int  # index of the edge of stamp 0, wraps at 2^32
    first_ticks: int  # t_0, wraps at 2^32
    stamps: int
    stride_edges: int
    span_ticks: int  # t_last - t_0
    s1_ticks: int
    s2_ticks: int
    q2_ticks2: int
    attenuation_db256: int  # level below full scale, 1/256 dB
    flags: int


SINGLE_TONE_FIELDS = tuple(map(Field, SingleToneRecord._fields, "IIHHIQQQHH"))

# One tone of a channelised counter on one channel in one gate.
TONE_FIELDS = (
    Field("phase_turn32", "i"),  # at mid-gate, against the tone's oscillator, 2^-32 turn
    Field("offset_hz16", "i"),  # frequency against the tone's oscillator, 2^-16 Hz
    Field("attenuation_db256", "H"),
    Field("sigma_code", "B"),  # standard deviation of the offset: 2^((code - 128) / 8) Hz
    Field("flags", "B"),
)


class Block(NamedTuple):
    """Head of a frame part: which tones of which channel follow."""

    channel: int
    encoding: int
    first_tone: int
    tones: int
    part: int
    parts: int


BLOCK_FIELDS = tuple(map(Field, Block._fields, "BBHHBB"))


class BlockEncoding(IntEnum):
    """How the tones of a frame part are written."""

    TONE_12 = 0  # TONE_FIELDS, 12 bytes a tone


SINGLE_TONE_STRUCT = struct_of(SINGLE_TONE_FIELDS)
TONE_STRUCT = struct_of(TONE_FIELDS)
BLOCK_STRUCT = struct_of(BLOCK_FIELDS)


_new_record = partial(tuple.__new__, SingleToneRecord)  # without the detour of the class: four thousand a second


def single_tone_records(payload: bytes) -> tuple[SingleToneRecord, ...]:
    """Return the records of a FRAME, channel 0 first; the payload is a whole number of them."""
    return tuple(map(_new_record, SINGLE_TONE_STRUCT.iter_unpack(payload)))
