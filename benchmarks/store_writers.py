"""Programs that write to a store below ROOT, and log each guarantee there: `store_writers.py STORE ROOT`."""

import asyncio
import hashlib
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, Final

from disk_crashes import ACKNOWLEDGED, Disk, changes

from resonator_daemon.calibration.plate_file import Session, write_plate_file
from resonator_daemon.calibration.run import abort_staged, accept_staged
from resonator_daemon.conditions import Condition
from resonator_daemon.config.text import plate_text
from resonator_daemon.daemon.config_store import ConfigStore
from resonator_daemon.plate import load_plate
from resonator_daemon.publishing.event_queue import EventQueue
from resonator_daemon.publishing.message_account import Account
from resonator_daemon.publishing.message_examples import EXAMPLES
from resonator_daemon.publishing.payloads import ContactEvent, Lost
from resonator_daemon.reasons import Reason, ReasonCode
from resonator_daemon.recording.file_series import Series
from resonator_daemon.recording.reader import Origin
from resonator_daemon.recording.recorder import Recorder, RecorderTimes
from resonator_daemon.session.frame_queue import FrameQueue
from resonator_daemon.session.host_time import HostTime
from resonator_daemon.session.link_events import Received, SnapshotTaken, StateAnnounced, WireEvent
from resonator_daemon.session.link_state_machine import LinkStateMachine

NAMES: Final = ("left", "right", "upper")  # of configurations, one after the other
PLATE: Final = load_plate("quartz16")
PLATE_TEXT: Final = plate_text(PLATE)
NEW_PLATE_TEXT: Final = plate_text(PLATE.model_copy(update={"force_max_newton": 5.0}))
_CONFIG: Final = 'name = "{}"\nplate = "quartz16"\nlink = "tcp://127.0.0.1:5000"\n'
_EVENTS, _PIECES = 20, 5  # between two promises
_HEADER: Final = {"name": "left", "daemon_boot_id": "a", "t_ns": 10**18, "t_uncertainty_ns": 42_000, "lost": Lost()}


def piece(number: int) -> bytes:
    """Return the bytes that the link of a recording receives, by number."""
    return number.to_bytes(4, "big") + Random(number).randbytes(7000)


def staged(plate: Path, text: str, calibration_id: str) -> dict[str, Any]:
    """Return a calibration that waits to be accepted, with `text` as the new plate file."""
    digest = hashlib.sha256(plate.read_bytes()).hexdigest()
    place = str(plate.resolve())
    result = {"id": calibration_id, "source": place, "sha256": digest, "output": place, "record": {}, "notes": []}
    return result | {"plate_file": text}


def write_configuration(root: Path) -> None:
    path = root.with_name("left.toml")
    for name in NAMES:
        path.write_text(_CONFIG.format(name))
        ConfigStore(path, root / "state" / "last-good").reload()
        _promise(root, name)


def write_calibration(root: Path) -> None:
    os.environ["XDG_STATE_HOME"] = str(root / "state")
    path = root.with_name("left.toml")
    plate, session = root / "own.toml", Session(path)
    write_plate_file(PLATE_TEXT, plate)
    _promise(root, "begun")
    for result, text in (("accepted", NEW_PLATE_TEXT), ("aborted", PLATE_TEXT)):
        with session.recording():
            session.write("loading", list(range(3000)))
            session.write("staged", staged(plate, text, result))
        _promise(root, "staged")
        if result == "accepted":
            accept_staged(path, as_json=True)
        else:
            abort_staged(path, as_json=True)
        _promise(root, result)


def write_events(root: Path) -> None:
    async def write() -> None:
        queue = EventQueue(Account(), root / "spool" / "left", lambda: None, boot_id="a")
        queue.start(lambda: None)
        for end in (_EVENTS, 2 * _EVENTS):
            for seq in range(end - _EVENTS, end):
                queue.put("event", ContactEvent(**{**EXAMPLES["ContactEvent"], **_HEADER, "seq": seq}))
            await asyncio.to_thread(_until, lambda end=end: queue.spooled == end and _all_synced(root))
            _promise(root, str(end))
        await queue.close()

    asyncio.run(write())


def write_recording(root: Path) -> None:
    series = Series(root / "recordings", "left", file_max_bytes=100_000)
    with Recorder(series, Origin(PLATE, "tcp://board:1"), times=RecorderTimes(batch_s=0.02, flush_s=0.0)) as recorder:
        for end in range(_PIECES, 6 * _PIECES, _PIECES):
            recorder.put(_snapshot(_at(100 * end)))
            for number in range(end - _PIECES, end):
                recorder.put(Received(_at(100 * end + number), piece(number)))
            _until(lambda end=end: recorder.events >= end and _all_synced(root))
            _promise(root, str(end))
    _promise(root, "stopped")


def _promise(root: Path, text: str) -> None:
    with (root / ACKNOWLEDGED).open("a") as file:
        file.write(f"{text}\n")


def _until(done: Callable[[], bool]) -> None:
    while not done():
        time.sleep(0.002)


def _all_synced(root: Path) -> bool:
    disk = Disk(root, changes(Path(os.environ["DISK_TRACE"])))
    return disk.after_failure("nothing", Random(0)) == disk.after_failure("everything", Random(0))


def _at(monotonic_ms: int) -> HostTime:
    return HostTime(10**9 + monotonic_ms * 10**6, 1_700_000_000 * 10**9, 7)


def _snapshot(now: HostTime) -> SnapshotTaken:
    """Return a link that was never open."""
    events: list[WireEvent] = []
    machine = LinkStateMachine(PLATE, FrameQueue(1 << 20, lambda: None), events.append)
    machine.apply(StateAnnounced(now, Condition.WAITING, Reason(ReasonCode.NO_SUCH_PORT, "no port")))
    return next(event for event in events if isinstance(event, SnapshotTaken))


WRITERS: Final = {
    "configuration": write_configuration,
    "calibration": write_calibration,
    "events": write_events,
    "recording": write_recording,
}


if __name__ == "__main__":
    WRITERS[sys.argv[1]](Path(sys.argv[2]))
