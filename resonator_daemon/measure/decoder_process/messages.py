"""Messages between a daemon and its decoder process; on the socket each is pickled, after its length."""

import pickle
import struct
from dataclasses import dataclass
from typing import Final, Literal

from resonator_daemon.base.reasons import Reason
from resonator_daemon.measure.sensors.surface_stream import SurfaceFrame, SurfaceSettings
from resonator_daemon.mqtt.headers import MeasuredFields
from resonator_daemon.mqtt.payloads import ContactEvent

Outcome = Literal["ready", "decoded", "too_old", "no_noise"]

LENGTH: Final = struct.Struct("<I")  # bytes


@dataclass(frozen=True)
class Work:
    """A frame to be decoded, and when it was offered by CLOCK_MONOTONIC."""

    frame: SurfaceFrame
    offered_ns: int


@dataclass(frozen=True)
class EndContacts:
    """Request to release all contacts; `header` is that of the message on `contacts`, None if there are no contacts."""

    header: MeasuredFields | None
    reason: Reason


@dataclass(frozen=True)
class Published:
    """An encoded message of a stream, by the path of its topic."""

    path: str
    payload: bytes
    t_ns: int


@dataclass(frozen=True)
class Results:
    """Messages that follow from a request; the last `Results` of a request have its outcome."""

    messages: tuple[Published | ContactEvent, ...]
    outcome: Outcome | None


@dataclass(frozen=True)
class SetUpStep:
    """A step of a set-up begins; "" when the set-up is done."""

    step: str


@dataclass(frozen=True)
class Undecodable:
    """The sites cannot be decoded, for the given reason; the process ends."""

    reason: str


Request = SurfaceSettings | Work | EndContacts  # the settings come first, and once
Reply = Results | SetUpStep | Undecodable


def packed(message: Request | Reply) -> bytes:
    """Return a message in its form on the socket."""
    content = pickle.dumps(message, protocol=5)
    return LENGTH.pack(len(content)) + content
