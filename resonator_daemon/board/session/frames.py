"""Output of the board reader: time-stamped frames, gaps, events of board and link, and counters of bytes and frames."""

from collections import Counter
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.host import PacketRefusal
from firmware_protocol.layouts import TONE_FIELDS, SingleToneRecord, ToneFlag, single_tone_records
from firmware_protocol.messages import Configuration, Description, Identity
from resonator_daemon.base.reasons import Condition, Reason
from resonator_daemon.board.session.clock import Instant, TickScale


@dataclass(frozen=True, slots=True)
class FrameLoss:
    """Frames that did not reach the measurement, by cause."""

    link_gap: int = 0  # never arrived
    damaged: int = 0  # arrived with a wrong checksum, or in pieces
    board_overflow: int = 0  # the board dropped them, and reported it
    host_overrun: int = 0  # the host's driver had no room for their bytes, and reported it
    queue_overflow: int = 0  # arrived, and the frame queue was full

    @property
    def total(self) -> int:
        return self.link_gap + self.damaged + self.board_overflow + self.host_overrun + self.queue_overflow

    def __add__(self, other: "FrameLoss") -> "FrameLoss":
        return FrameLoss(*(getattr(self, cause.name) + getattr(other, cause.name) for cause in fields(self)))

    def within(self, lost: "FrameLoss") -> "FrameLoss":
        """Return this part of `lost` after losses were moved there to `board_overflow`; the sum stays."""
        link_gap, damaged = (
            max(0, min(pair)) for pair in ((self.link_gap, lost.link_gap), (self.damaged, lost.damaged))
        )
        moved = self.link_gap + self.damaged - link_gap - damaged
        return replace(self, link_gap=link_gap, damaged=damaged, board_overflow=self.board_overflow + moved)


@dataclass(slots=True)
class BootCounters:
    """What one boot of a board sent; a gap counts for the boot whose frame ended it."""

    boot_id: int
    connections: int = 0
    frames: int = 0
    lost: FrameLoss = field(default_factory=FrameLoss)  # without queue_overflow: the queue does not distinguish boots
    lost_in_outages: FrameLoss = field(default_factory=FrameLoss)  # of `lost`: what `state/link` reports as outages


BOOTS_REMEMBERED = 8


@dataclass(slots=True)
class LinkCounters:
    """Where every byte and every frame of the link went; complete at any instant.

    bytes_received = bytes_accepted + bytes_other_version + bytes_echo + bytes_discarded + bytes_waiting.
    """

    bytes_received: int = 0
    bytes_accepted: int = 0
    bytes_other_version: int = 0
    bytes_echo: int = 0
    bytes_discarded: int = 0
    bytes_waiting: int = 0
    messages_stale: int = 0
    messages_malformed: int = 0
    messages_unknown: int = 0
    log_lines_dropped: int = 0  # of the board's log, beyond what anyone would read
    frames: int = 0  # handed on or lost to queue_overflow
    parts_lost: int = 0  # of frames that did arrive
    connections: int = 0
    host_overruns: int = 0  # reports of the host's driver that it had no room
    clock_outliers: int = 0  # pings that contradicted the others
    clock_restarts: int = 0
    refusals: Counter[PacketRefusal] = field(default_factory=Counter)  # of malformed messages, by reason
    lost: FrameLoss = field(default_factory=FrameLoss)
    boots: list[BootCounters] = field(default_factory=list)  # the latest, the present one last

    def boot(self, boot_id: int) -> BootCounters:
        """Return the counters of the present boot, made where there is none, and now the last."""
        boot = next((boot for boot in self.boots if boot.boot_id == boot_id), BootCounters(boot_id))
        self.boots = [*(other for other in self.boots if other is not boot), boot][-BOOTS_REMEMBERED:]
        return boot

    def copy(self) -> "LinkCounters":
        return replace(self, refusals=self.refusals.copy(), boots=[replace(boot) for boot in self.boots])


Tones = NDArray[np.void]
TONE = np.dtype([(field.name, "<" + field.code) for field in TONE_FIELDS])
_UNUSABLE = ToneFlag.NO_SIGNAL | ToneFlag.SATURATED | ToneFlag.OUT_OF_BAND
_SINGLE_TONE_BYTES = 560  # a frame with its integers, payload and time scale, as measured by tracemalloc
_CHANNELISED_BYTES = 1400  # besides its records


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


@dataclass(slots=True)  # not frozen, which takes three times as long to make: a thousand a second
class SingleToneFrame:
    """One gate of a single-tone counter; `index` counts gates without a break, also through outages."""

    index: int
    board_ticks: int  # at the end of the gate
    middle_ticks: int
    scale: TickScale  # as known when the frame was received
    payload: bytes  # parsed where it is used: the reader of the link has no time for it

    @property
    def gate_middle(self) -> Instant:
        """The middle of the gate on the host's clocks."""
        return self.scale.at(self.middle_ticks)

    @property
    def records(self) -> tuple[SingleToneRecord, ...]:
        """The reading of each channel."""
        return single_tone_records(self.payload)

    @property
    def memory_bytes(self) -> int:
        return _SINGLE_TONE_BYTES


@dataclass(slots=True)
class ChannelisedFrame:
    """One gate of a channelised counter; all arrays are (4, tones), in the wire's units."""

    index: int
    board_ticks: int  # at the end of the gate
    gate_middle: Instant
    tones: Tones

    @property
    def phase_turn32(self) -> NDArray[np.int32]:
        return self.tones["phase_turn32"]

    @property
    def offset_hz16(self) -> NDArray[np.int32]:
        return self.tones["offset_hz16"]

    @property
    def sigma_code(self) -> NDArray[np.uint8]:
        return self.tones["sigma_code"]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which tones arrived with a usable frequency."""
        return known_tones(self.tones)

    @property
    def memory_bytes(self) -> int:
        return _CHANNELISED_BYTES + self.tones.nbytes


Frame = SingleToneFrame | ChannelisedFrame


@dataclass(frozen=True, slots=True)
class Gap:
    """Gates that are missing between the frame before and the frame after.

    `loss` also corrects the causes of earlier gaps, if the board's report of them came late. A correction's sum is 0.
    """

    first_index: int
    loss: FrameLoss


@dataclass(frozen=True, slots=True)
class BoardOnline:
    """A board was identified, is compatible with the plate, and measures.

    `continues`: its ticks go on from those of the frames before, so that what was estimated from them holds.
    """

    identity: Identity
    description: Description
    boot_id: int
    configuration: Configuration
    continues: bool


@dataclass(frozen=True, slots=True)
class BoardRefused:
    """A board answered that cannot serve this plate or does not support this protocol."""

    problems: tuple[Reason, ...]
    other_protocol: bool = False


@dataclass(frozen=True, slots=True)
class LinkChange:
    """The link's state changed, or its reason: waiting, starting, online, stalled, lost or refused."""

    state: Condition
    reason: Reason
    since_utc_ns: int  # of the state
    utc_ns: int  # of this announcement


@dataclass(frozen=True, slots=True)
class Outage:
    """A past time without frames, from the middle of the last gate before it to that of the first gate after it.

    Both are by the clock as it is at the end.
    """

    start_utc_ns: int
    end_utc_ns: int
    frames_lost: int
    reason: Reason  # of the link when it began


@dataclass(frozen=True, slots=True)
class BoardLogLine:
    """A line of the board's log."""

    level: int
    text: str


@dataclass(frozen=True, slots=True)
class BlinkAnswered:
    """The answer to a request to blink: the reason why the board does not; None where it does."""

    refused: str | None


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """A request that changes how all later frames are measured; `key` identifies the requester."""

    key: str
    request: str


@dataclass(frozen=True, slots=True)
class ReaderFailed:
    """The reader ended by a defect of the program; no further arrivals."""

    error: Exception


Arrival = (
    Frame
    | Gap
    | BoardOnline
    | BoardRefused
    | LinkChange
    | Outage
    | BoardLogLine
    | BlinkAnswered
    | ControlRequest
    | ReaderFailed
)
