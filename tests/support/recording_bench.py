"""What happened on an emulated board's link, recorded to a file and replayed as fast as it goes."""

import json
from dataclasses import fields, is_dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from mcap.reader import make_reader

from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.recording.event_replay import Replay
from resonator_daemon.board.recording.file_series import Series
from resonator_daemon.board.recording.reader import Origin, open_recording
from resonator_daemon.board.recording.recorder import Recorder, RecorderTimes
from resonator_daemon.board.session.board_reader import FRAME_QUEUE_BYTES
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import Arrival, LinkCounters
from resonator_daemon.board.session.link_events import Received, SnapshotTaken, StateAnnounced, WireEvent
from resonator_daemon.board.session.link_state_machine import LinkStateMachine

PLATE = load_plate("quartz16")
ONE_BATCH = RecorderTimes(batch_s=3600.0)
NO_PAUSE = RecorderTimes(retry_s=0.0)
FLUSHING = RecorderTimes(flush_s=0.0, retry_s=0.0)


def at(monotonic_ms: int) -> HostTime:
    return HostTime(10**9 + monotonic_ms * 10**6, 1_700_000_000 * 10**9 + monotonic_ms, 7)


def record(path: Path, events: list[WireEvent], plate: Plate = PLATE, **options: Any) -> Recorder:
    with Recorder(path, Origin(plate, "tcp://board:1"), **options) as recorder:
        for event in events:
            recorder.put(event)
    return recorder


def read(path: Path, plate: Plate = PLATE) -> tuple[list[WireEvent], str | None]:
    with open_recording(str(path), plate) as recording:
        return list(recording.events()), recording.damage


def replayed(path: Path, plate: Plate = PLATE) -> tuple[list[Arrival], LinkCounters, int]:
    """Return what arrives, the account and how many differences there were."""
    queue = FrameQueue(FRAME_QUEUE_BYTES, lambda: None)
    machine = LinkStateMachine(plate, queue, lambda _: None)
    with open_recording(str(path), plate) as recording:
        replay = Replay(recording, machine)
        for event in recording.events():
            replay.apply(event)
        replay.end()
    return queue.pop_all(), machine.counters(), replay.differences


def same(one: object, other: object) -> bool:
    """Like ==, with arrays compared to the bit, and of one type."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return bool(np.array_equal(one, other))
    if is_dataclass(one):
        return all(same(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    return one == other


def marks(path: Path) -> list[tuple[int, str]]:
    """Return times and texts of the marks, as any reader of such files finds them."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[])
        return [
            (message.log_time, json.loads(message.data)["message"])
            for schema, channel, message in reader.iter_messages(topics=["marks"])
            if schema is not None and (schema.name, channel.message_encoding) == ("foxglove.Log", "json")
        ]


def snapshot(now: HostTime) -> SnapshotTaken:
    """How a link stands that was never open."""
    told: list[WireEvent] = []
    LinkStateMachine(PLATE, FrameQueue(FRAME_QUEUE_BYTES, lambda: None), told.append).apply(
        StateAnnounced(now, Condition.WAITING, Reason(ReasonCode.NO_SUCH_PORT, "no port"))
    )
    assert isinstance(told[-1], SnapshotTaken)
    return told[-1]


def made(directory: Path, minute: int, name: str = "left", says: str | None = None, size_bytes: int = 20_000) -> Path:
    """A recording of a certain age, in the order of minutes, with a daemon's name in its own and one inside."""
    path = Series(directory, name).path((1_700_000_000 + 60 * minute) * 10**9)
    with Recorder(path, Origin(PLATE, "tcp://board:1", name=says or name)) as recorder:
        recorder.put(Received(at(0), Random(minute).randbytes(size_bytes)))
    return path
