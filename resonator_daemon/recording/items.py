"""What waits to be written to a recording."""

from typing import Final

from resonator_daemon.recording.reader import Mark
from resonator_daemon.recording.writer import Published
from resonator_daemon.session.frames import BoardOnline
from resonator_daemon.session.link_events import Received, Sent, SnapshotTaken, WireEvent

EVENT_BYTES: Final = 300  # of memory, besides its data

_SNAPSHOT_BYTES: Final = 10_000  # most of it vertices of the clock's hulls

Item = WireEvent | Mark | BoardOnline | Published


def size_bytes(item: Item) -> int:
    """Return about what an item takes of memory while it waits."""
    match item:
        case Received() | Sent():
            return EVENT_BYTES + len(item.data)
        case Mark():
            return EVENT_BYTES + len(item.text)
        case Published():
            return EVENT_BYTES + len(item.payload)
        case SnapshotTaken():
            return _SNAPSHOT_BYTES
        case BoardOnline():
            return 0
        case _:
            return EVENT_BYTES
