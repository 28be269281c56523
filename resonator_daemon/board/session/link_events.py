"""Events of a link: the complete input of a connection, so that a recording can be replayed."""

import json
import struct
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, get_args

from pydantic import Field, Strict, TypeAdapter, ValidationError

from firmware_protocol.host import Described
from firmware_protocol.messages import Configuration
from resonator_daemon.base.host.load import NO_LOAD, HostLoad, LoadSample
from resonator_daemon.base.reasons import Condition, Reason
from resonator_daemon.board.session.clock import ClockSnapshot, HostTime
from resonator_daemon.board.session.frame_numbers import NumberingSnapshot
from resonator_daemon.board.session.link_state import LinkStateSnapshot, StoredReason
from resonator_daemon.board.session.pings import Ping

_HEAD = struct.Struct("<Bq")  # kind, boottime_less_monotonic_ns


class ConnectionSnapshot(NamedTuple):
    """A connection whose board counts, between two packets and two frames.

    `request_number` is that of the last request, `answered_ns` the monotonic time of the last answer, `rate_doubt` what
    is odd about the board's ticks, `newest_ticks` the newest in any message.
    """

    described: Described
    configuration: Configuration
    request_number: int
    answered_ns: int
    rate_doubt: str | None
    newest_ticks: int
    clock: ClockSnapshot
    pings: tuple[Ping, ...]
    load: HostLoad = HostLoad()  # older recordings have none


class LinkSnapshot(NamedTuple):
    """State of a link; `running` None while it is closed, `known` the board of the connection before."""

    state: LinkStateSnapshot
    numbers: NumberingSnapshot
    known: Described | None
    running: ConnectionSnapshot | None


class StateAnnounced(NamedTuple):
    """A state of the link was announced while no link was open."""

    now: HostTime
    state: Condition
    reason: Reason


class Opened(NamedTuple):
    """The link was opened."""

    now: HostTime


class Received(NamedTuple):
    """Bytes had come by then."""

    now: HostTime
    data: bytes


class TimersRun(NamedTuple):
    """Timers were run; `idle`: no data had arrived."""

    now: HostTime
    idle: bool
    load: LoadSample = NO_LOAD


class Sent(NamedTuple):
    """Bytes went out, which follow from what was received, or from timers, at `now` or before."""

    now: HostTime
    data: bytes


class Overrun(NamedTuple):
    """The host's driver reported lost bytes."""

    now: HostTime


class StopRequested(NamedTuple):
    """The reader is about to stop the board."""

    now: HostTime


class Lost(NamedTuple):
    """The open link went away, or the board on it has to be identified again."""

    now: HostTime
    reason: Reason


class Refused(NamedTuple):
    """The board cannot serve the plate."""

    now: HostTime
    problems: tuple[Reason, ...]
    other_protocol: bool


class Closed(NamedTuple):
    """The link was closed, whatever the reason."""

    now: HostTime


class Skipped(NamedTuple):
    """Events before this that the recording lacks: the disk was too slow, or they were damaged."""

    now: HostTime
    events: int
    size_bytes: int


class SnapshotTaken(NamedTuple):
    """State of the link before any event at `now` or later; a replay may begin or go on with it."""

    now: HostTime
    snapshot: LinkSnapshot


class BlinkRequested(NamedTuple):
    """The board on the open link was asked to blink."""

    now: HostTime


class ControlRequested(NamedTuple):
    """A request changed how all later frames are measured; `key` identifies the requester."""

    now: HostTime
    key: str
    request: str


# A kind's place is its number in files: new ones are appended.
WireEvent = (
    StateAnnounced
    | Opened
    | Received
    | TimersRun
    | Sent
    | Overrun
    | StopRequested
    | Lost
    | Refused
    | Closed
    | Skipped
    | SnapshotTaken
    | BlinkRequested
    | ControlRequested
)

_KINDS: tuple[type[WireEvent], ...] = get_args(WireEvent)
_NUMBERS = {kind: number for number, kind in enumerate(_KINDS)}
_Text = Annotated[str, Strict()]
_Count = Annotated[int, Strict(), Field(ge=0, lt=2**63)]
_SNAPSHOT = TypeAdapter(LinkSnapshot)
_JSON: Mapping[type[WireEvent], TypeAdapter[Any]] = {  # of what an event has besides its time
    StateAnnounced: TypeAdapter(tuple[Condition, StoredReason]),
    Lost: TypeAdapter(tuple[StoredReason]),
    Refused: TypeAdapter(tuple[tuple[StoredReason, ...], Annotated[bool, Strict()]]),
    Skipped: TypeAdapter(tuple[_Count, _Count]),
    ControlRequested: TypeAdapter(tuple[_Text, _Text]),
}


def encode(event: WireEvent) -> bytes:
    """Return the event without its monotonic time and UTC, which travel next to it."""
    match event:
        case Received() | Sent():
            body = event.data
        case TimersRun():
            body = bytes([event.idle, *event.load] if any(event.load) else [event.idle])
        case SnapshotTaken():
            body = _json_bytes(_SNAPSHOT.dump_python(event.snapshot, mode="json"))
        case _:
            body = _json_bytes(event[1:]) if type(event) in _JSON else b""
    return _HEAD.pack(_NUMBERS[type(event)], event.now.boottime_less_monotonic_ns) + body


def _json_bytes(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False).encode(errors="replace")  # reasons may name paths that are no text


def decode(data: bytes, monotonic_ns: int, utc_ns: int) -> WireEvent:
    """Return the event that `encode` was given.

    Raises
    ------
    ValueError
        These are no bytes of `encode`.
    """
    if len(data) < _HEAD.size:
        raise ValueError(f"an event has at least {_HEAD.size} bytes, got {len(data)}")
    number, boottime_less_monotonic_ns = _HEAD.unpack_from(data)
    if number >= len(_KINDS):
        raise ValueError(f"no event has number {number}; the highest is {len(_KINDS) - 1}")
    # Two thousand events a second of recorded time: tuples are made without the detour of their classes.
    new_tuple, kind, body = tuple.__new__, _KINDS[number], data[_HEAD.size :]
    now = new_tuple(HostTime, (monotonic_ns, utc_ns - monotonic_ns, boottime_less_monotonic_ns))
    if kind is Received:
        return new_tuple(Received, (now, body))
    if kind is Sent:
        return Sent(now, body)
    if kind is TimersRun:
        return new_tuple(TimersRun, (now, body[:1] == b"\1", LoadSample(*body[1:3])))
    try:
        if kind is SnapshotTaken:
            return SnapshotTaken(now, _SNAPSHOT.validate_json(body))
        fields: tuple[Any, ...] = _JSON[kind].validate_json(body) if kind in _JSON else ()
    except ValidationError as error:
        raise ValueError(f"{kind.__name__} cannot be read: {error.errors()[0]['msg']}") from error
    event: WireEvent = kind(now, *fields)
    return event
