"""What happens on a link, as events: all that a connection depends on, so that a recording of them can be replayed."""

import json
import struct
from typing import NamedTuple

from pydantic import TypeAdapter, ValidationError

from resonator_daemon.session.host_time import HostTime
from resonator_daemon.session.link_snapshot import LinkSnapshot
from resonator_daemon.session.link_state import STATES

_HEAD = struct.Struct("<Bq")  # kind, boottime_less_monotonic_ns


class StateAnnounced(NamedTuple):
    """A state of the link was announced while no link was open."""

    now: HostTime
    state: str
    reason: str


class Opened(NamedTuple):
    """The link was opened."""

    now: HostTime


class Received(NamedTuple):
    """Bytes had come by then."""

    now: HostTime
    data: bytes


class TimersRun(NamedTuple):
    """Timers were run; `idle`: nothing had come."""

    now: HostTime
    idle: bool


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
    """The open link went away, or the board on it is to be asked anew."""

    now: HostTime
    reason: str


class Refused(NamedTuple):
    """The board cannot serve the plate."""

    now: HostTime
    problems: tuple[str, ...]
    other_protocol: bool


class Closed(NamedTuple):
    """The link was closed, whatever the reason."""

    now: HostTime


class Skipped(NamedTuple):
    """Events that happened before this and are not in the recording: the disk was too slow for them."""

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
    """A request changed how all later frames are measured; `key` identifies whoever waits for the answer."""

    now: HostTime
    key: str
    request: str


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

# A kind's place is its number in files: new ones are appended.
_KINDS: tuple[type[WireEvent], ...] = (
    StateAnnounced,
    Opened,
    Received,
    TimersRun,
    Sent,
    Overrun,
    StopRequested,
    Lost,
    Refused,
    Closed,
    Skipped,
    SnapshotTaken,
    BlinkRequested,
    ControlRequested,
)
_SHOWN = 60  # characters of what cannot be read
_SNAPSHOT = TypeAdapter(LinkSnapshot)
_NUMBERS = {kind: number for number, kind in enumerate(_KINDS)}


def encode(event: WireEvent) -> bytes:
    """Return the event without its monotonic time and UTC, which travel beside it."""
    head = _HEAD.pack(_NUMBERS[type(event)], event.now.boottime_less_monotonic_ns)
    match event:
        case Received() | Sent():
            return head + event.data
        case TimersRun():
            return head + bytes([event.idle])
        case Opened() | Overrun() | StopRequested() | Closed() | BlinkRequested():
            return head
        case SnapshotTaken():
            text = json.dumps(_SNAPSHOT.dump_python(event.snapshot, mode="json"), ensure_ascii=False)
            return head + text.encode(errors="replace")  # reasons may name paths that are no text
        case StateAnnounced() | Lost() | Refused() | Skipped() | ControlRequested():
            return head + json.dumps(event[1:], ensure_ascii=False).encode(errors="replace")


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
    if kind is TimersRun:
        return new_tuple(TimersRun, (now, body == b"\1"))
    if kind is Sent:
        return Sent(now, body)
    if kind is Opened or kind is Overrun or kind is StopRequested or kind is Closed or kind is BlinkRequested:
        return kind(now)
    if kind is SnapshotTaken:
        return SnapshotTaken(now, _snapshot(body))
    match kind, json.loads(body):
        case (_, [str() as state, str() as reason]) if kind is StateAnnounced and state in STATES:
            return StateAnnounced(now, state, _text(reason))
        case (_, [str() as reason]) if kind is Lost:
            return Lost(now, _text(reason))
        case (_, [list() as problems, bool() as other_protocol]) if kind is Refused:
            return Refused(now, tuple(_text(str(problem)) for problem in problems), other_protocol)
        case (_, [str() as key, str() as request]) if kind is ControlRequested:
            return ControlRequested(now, _text(key), _text(request))
        case (_, [int() as events, int() as size_bytes]) if kind is Skipped and _counts(events, size_bytes):
            return Skipped(now, events, size_bytes)
    raise ValueError(f"{kind.__name__} cannot be read from {body[:_SHOWN]!r}")


def _snapshot(body: bytes) -> LinkSnapshot:
    try:
        snapshot = _SNAPSHOT.validate_json(body)
    except ValidationError as error:
        raise ValueError(f"Standing cannot be read: {error.errors()[0]['msg']}") from error
    if snapshot.state.state not in ("", *STATES):
        raise ValueError(f"{snapshot.state.state[:_SHOWN]!r} is no state of a link")
    return snapshot


def _text(text: str) -> str:
    text.encode()  # a ValueError of half a pair of surrogates, which JSON can hold and nothing else
    return text


def _counts(*numbers: int) -> bool:
    return all(0 <= number < 2**63 for number in numbers)
