"""Power failures while a store of the daemon is written: guaranteed data is complete, and no partial data is used.

`benchmarks/power_failure.py` runs all stores.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Final

import store_writers
from disk_crashes import ACKNOWLEDGED, Disk, changes, failures, traced
from store_writers import NAMES, NEW_PLATE_TEXT, PLATE_TEXT, piece

from resonator_daemon.calibration.plate_file import Session
from resonator_daemon.daemon.config_store import ConfigStore
from resonator_daemon.errors import ConfigurationError
from resonator_daemon.publishing.spool import Progress, Spool, SpoolError
from resonator_daemon.recording.reader import RecordingUnusableError, open_recording
from resonator_daemon.session.link_events import Received

_FROM_THE_FIRST: Final = Progress((-1, -1), (1, -1))
_MCAP_END: Final = b"\x89MCAP0\r\n"
_IN_MEMORY: Final = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # the readers synchronise, too

Promises = tuple[str, ...]


def read_configuration(disk: Path, folder: Path, promised: Promises) -> bool:
    path = folder / "left.toml"
    path.write_text("bad\n")
    try:
        name = ConfigStore(path, disk / "state" / "last-good").load().config.name
    except ConfigurationError:
        return not promised
    return name in NAMES[max(0, len(promised) - 1) : len(promised) + 1]


def read_calibration(disk: Path, folder: Path, promised: Promises) -> bool:
    os.environ["XDG_STATE_HOME"] = str(disk / "state")
    plate = disk / "own.toml"
    found = plate.read_text() if plate.exists() else None, (Session(folder / "left.toml").staged() or {}).get("id")
    possible = {
        (): {(None, None), (PLATE_TEXT, None)},
        ("begun",): {(PLATE_TEXT, None), (PLATE_TEXT, "accepted")},
        ("begun", "staged"): {(PLATE_TEXT, "accepted"), (NEW_PLATE_TEXT, "accepted"), (NEW_PLATE_TEXT, None)},
        ("begun", "staged", "accepted"): {(NEW_PLATE_TEXT, None), (NEW_PLATE_TEXT, "aborted")},
        ("begun", "staged", "accepted", "staged"): {(NEW_PLATE_TEXT, "aborted"), (NEW_PLATE_TEXT, None)},
        ("begun", "staged", "accepted", "staged", "aborted"): {(NEW_PLATE_TEXT, None)},
    }
    return found in possible[promised]


def read_events(disk: Path, _: Path, promised: Promises) -> bool:
    spool = Spool(disk / "spool" / "left")
    try:
        waiting = [(event.key[1], event.payload) for event in spool.read(_FROM_THE_FIRST, 1000)]
        stored = spool.transact(lambda found: found.execute("SELECT seq, payload FROM history ORDER BY seq").fetchall())
    except SpoolError:
        return False
    finally:
        spool.close()
    for events in (waiting, stored):
        numbers = list(range(max(len(events), int(promised[-1]) if promised else 0)))
        if [(seq, json.loads(payload)["seq"]) for seq, payload in events] != [(number, number) for number in numbers]:
            return False
    return True


def read_recording(disk: Path, _: Path, promised: Promises) -> bool:
    found: list[int] = []
    for path in sorted((disk / "recordings").glob("*")):
        try:
            with open_recording(str(path)) as recording:
                pieces = [event.data for event in recording.events() if isinstance(event, Received)]
        except RecordingUnusableError:
            continue  # it has no complete beginning
        numbers = [int.from_bytes(data[:4], "big") for data in pieces]
        gap = numbers != list(range(numbers[0], numbers[0] + len(numbers))) if numbers else False
        cut_unreported = recording.damage is None and not path.read_bytes().endswith(_MCAP_END)
        if gap or cut_unreported or pieces != [piece(number) for number in numbers]:
            return False
        found += numbers
    stopped = promised[-1:] == ("stopped",)
    count = len(found) if stopped else int(promised[-1]) if promised else 0
    return found[:count] == list(range(count)) and (not stopped or count == int(promised[-2]))


READERS: Final[dict[str, Callable[[Path, Path, Promises], bool]]] = {
    "configuration": read_configuration,
    "calibration": read_calibration,
    "events": read_events,
    "recording": read_recording,
}


def fail_while_writing(store: str, folder: Path, *, others: int, seed: int) -> tuple[int, list[str]]:
    """Run a program that writes to a store, and read it after each power failure; return their number, and errors."""
    root = folder / "disk"
    root.mkdir()
    command = [sys.executable, store_writers.__file__, store, str(root)]
    subprocess.run(command, env=os.environ | traced(folder, root), check=True, timeout=30, stdout=subprocess.DEVNULL)
    log = changes(folder / "trace")
    present = {str(path.relative_to(root)): path.read_bytes() if path.is_file() else None for path in root.rglob("*")}
    del present[ACKNOWLEDGED]
    wrong = []
    if Disk(root, log).after_failure("everything", Random(0)) != present:
        wrong.append(f"{store}: the log lacks changes")
    count = 0
    for failure in failures(log, root, others=others, seed=seed):
        count += 1
        with TemporaryDirectory(dir=_IN_MEMORY) as place:
            failure.put(Path(place))
            if not READERS[store](Path(place), folder, failure.acknowledged):
                wrong.append(f"{store}: outcome {count}, after {failure.acknowledged[-1:]}")
    return count, wrong
