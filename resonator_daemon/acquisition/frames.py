"""What the acquisition hands on: frames with their time, gaps, and news of board and link."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import SingleToneRecord
from firmware_protocol.messages import Configuration, Description, Identity
from resonator_daemon.acquisition.clock import Instant


@dataclass(frozen=True, slots=True)
class SingleToneFrame:
    """One gate of a single-tone counter; `index` counts gates without a break, also through outages."""

    index: int
    board_ticks: int
    gate_end: Instant
    records: tuple[SingleToneRecord, ...]


@dataclass(frozen=True, slots=True)
class ChannelisedFrame:
    """One gate of a channelised counter: arrays (4, tones) in the wire's units; `known` tells what arrived."""

    index: int
    board_ticks: int
    gate_end: Instant
    phase_turn32: NDArray[np.int32]
    offset_hz16: NDArray[np.int32]
    sigma_code: NDArray[np.uint8]
    known: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class FrameLoss:
    """Frames that did not reach the measurement, by cause."""

    link_gap: int = 0  # never arrived
    damaged: int = 0  # arrived with a wrong check sum, or in pieces
    board_overflow: int = 0  # the board dropped them, and said so
    host_overrun: int = 0  # arrived, and the ring was full

    @property
    def total(self) -> int:
        return self.link_gap + self.damaged + self.board_overflow + self.host_overrun

    def __add__(self, other: "FrameLoss") -> "FrameLoss":
        return FrameLoss(
            self.link_gap + other.link_gap,
            self.damaged + other.damaged,
            self.board_overflow + other.board_overflow,
            self.host_overrun + other.host_overrun,
        )


@dataclass(frozen=True, slots=True)
class Gap:
    """Gates that are missing between the frame before and the frame after."""

    first_index: int
    loss: FrameLoss


@dataclass(frozen=True, slots=True)
class BoardOnline:
    """A board was identified, fits the plate, and counts."""

    identity: Identity
    description: Description
    boot_id: int
    configuration: Configuration


@dataclass(frozen=True, slots=True)
class BoardRefused:
    """A board answered that cannot serve this plate or speak this protocol; each problem is one sentence."""

    problems: tuple[str, ...]
    other_protocol: bool = False


@dataclass(frozen=True, slots=True)
class LinkChange:
    """The link's state changed: waiting, starting, online, stalled, lost or refused."""

    state: str
    reason: str
    since_utc_ns: int


@dataclass(frozen=True, slots=True)
class BoardSays:
    """A line of the board's log."""

    level: int
    text: str


@dataclass(frozen=True, slots=True)
class ReaderFailed:
    """The reader ended by a mistake of ours; nothing will arrive any more."""

    error: Exception


Arrival = SingleToneFrame | ChannelisedFrame | Gap | BoardOnline | BoardRefused | LinkChange | BoardSays | ReaderFailed


@dataclass(slots=True)
class LinkAccount:
    """Where every byte and every frame of the link went; complete at any instant.

    bytes_received = bytes_accepted + bytes_other_version + bytes_own_direction + bytes_discarded + bytes_waiting.
    """

    bytes_received: int = 0
    bytes_accepted: int = 0
    bytes_other_version: int = 0
    bytes_own_direction: int = 0
    bytes_discarded: int = 0
    bytes_waiting: int = 0
    messages_stale: int = 0
    messages_malformed: int = 0
    messages_unknown: int = 0
    frames: int = 0  # handed on or lost to host_overrun
    parts_lost: int = 0  # of frames that did arrive
    frames_incomplete: int = 0
    connections: int = 0
    lost: FrameLoss = field(default_factory=FrameLoss)
