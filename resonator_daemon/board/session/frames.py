"""What a reader passes on: frames with their time, gaps, and events of board and link."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import TONE_FIELDS, SingleToneRecord, ToneFlag, single_tone_records
from firmware_protocol.messages import Configuration, Description, Identity
from resonator_daemon.base.reasons import Condition, Reason
from resonator_daemon.board.session.clock import Instant, TickScale
from resonator_daemon.board.session.counters import FrameLoss

Tones = NDArray[np.void]
TONE = np.dtype([(field.name, "<" + field.code) for field in TONE_FIELDS])
_UNUSABLE = ToneFlag.NO_SIGNAL | ToneFlag.SATURATED | ToneFlag.OUT_OF_BAND
_SINGLE_TONE_BYTES = 560  # a frame with its integers, payload and time scale, as tracemalloc sees it
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
    def variance_hz2(self) -> NDArray[np.float64]:
        """Of the offsets; infinite where they are not known."""
        return variance_of(self.tones)

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
    """A board was identified, fits the plate, and counts.

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
    """A time without frames that is over: from the middle of the last gate before to that of the first after.

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
    """The reader ended by a mistake of ours; nothing will arrive any more."""

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
