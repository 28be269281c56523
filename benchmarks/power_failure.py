"""Loss by a power failure of a daemon that records without a broker: at most the last second of frames and events.

Run it with `make soak`, or `python benchmarks/power_failure.py [--seconds N] [--moments N] [--seed N]`. The daemon runs
once, with an emulated quartz16 that is pressed at full rate, and all its changes to the disk are logged. For moments
around each fsync and others by chance, the disk is restored to what it may hold then (`disk_crashes.py`), and opened
by the daemon's own readers. Then each store is written alone, up to promises that must hold (`store_failures.py`).
Exit code 1 when a file cannot be read, more than a second is missing, or a promise is broken.
"""

import argparse
import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from disk_crashes import changes, failures, traced
from emulated_board import emulated_board
from store_failures import READERS, fail_while_writing

from resonator_daemon.publishing.spool import FILE, Progress, Spool
from resonator_daemon.recording.reader import RecordingUnusableError, open_recording

LOSS_AT_MOST_S = 1.0
_ALL = Progress((-1, -1), (1, -1))
_CONFIG = """
name = "left"
plate = "quartz16"
link = "{link}"
[mqtt]
url = "mqtt://127.0.0.1:9"
[recording]
autostart = true
directory = "{root}/recordings"
file_max_mb = 1
"""


@dataclass
class Result:
    """Results over all moments."""

    moments: int = 0
    syncs: int = 0
    events: int = 0
    frames_lost_s: list[float] = field(default_factory=list)
    events_lost_s: list[float] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)


def fail_and_read(seconds: float, moments: int, seed: int, folder: Path) -> Result:
    """Run a daemon for so many seconds, then check the disk after each power failure."""
    root = folder / "disk"
    root.mkdir()
    with emulated_board("quartz16", folder, "--seed", str(seed)) as (link, _):
        config = folder / "left.toml"
        config.write_text(_CONFIG.format(link=link, root=root))
        command = [sys.executable, "-m", "resonator_daemon", "run", "--config", str(config)]
        environment = os.environ | traced(folder, root) | {"XDG_STATE_HOME": str(root / "state")}
        environment.pop("STATE_DIRECTORY", None)
        process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
        try:
            time.sleep(seconds)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()
    log = changes(folder / "trace")
    utc_ahead_ns = time.time_ns() - time.monotonic_ns()
    occurred_ns = _events(next(root.glob(f"state/**/{FILE}")).parent)
    result = Result(syncs=sum(change.kind == "end" for change in log), events=len(occurred_ns))
    begun_ns = next(change.time_ns for change in log if change.data.endswith(b".mcap"))
    for failure in failures(log, root, others=moments, seed=seed):
        result.moments += 1
        with tempfile.TemporaryDirectory() as place:
            failure.put(Path(place))
            _judge(Path(place), failure.time_ns, begun_ns, result)
            stored = next((path.parent for path in Path(place).glob(f"state/**/{FILE}")), None)
            present = _events(stored) if stored else {}
        missing = [number for number in occurred_ns if number not in present]
        if any(number > min(missing, default=number) for number in present):
            result.wrong.append(f"events {missing} are missing before others")
        lost_s = max((1e-9 * (failure.time_ns + utc_ahead_ns - occurred_ns[number]) for number in missing), default=0.0)
        result.events_lost_s.append(max(0.0, lost_s))
    return result


def _events(directory: Path) -> dict[int, int]:
    """Return the times of the waiting events, by number."""
    spool = Spool(directory)
    try:
        found = [json.loads(event.payload) for event in spool.read(_ALL, 1_000_000)]
    finally:
        spool.close()
    return {event["seq"]: int(event["t_ns"]) for event in found}


def _judge(disk: Path, failed_ns: int, begun_ns: int, result: Result) -> None:
    last_ns = begun_ns
    for path in sorted(disk.glob("recordings/*")):
        try:
            with open_recording(str(path)) as recording:
                times_ns = [event.now.monotonic_ns for event in recording.events()]
        except RecordingUnusableError:
            continue  # a file of the last second
        if times_ns != sorted(times_ns):
            result.wrong.append(f"{path.name}: events are out of order")
        last_ns = max([last_ns, *times_ns])
    result.frames_lost_s.append(max(0.0, 1e-9 * (failed_ns - last_ns)))


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--moments", type=int, default=200, help="besides those of each fsync")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.disable(logging.ERROR)  # the readers report what they find
    with tempfile.TemporaryDirectory() as folder:
        result = fail_and_read(options.seconds, options.moments, options.seed, Path(folder))
    for what, lost_s in (("frames", sorted(result.frames_lost_s)), ("events", sorted(result.events_lost_s))):
        print(
            f"{what} missing before a power failure: median {lost_s[len(lost_s) // 2]:.2f} s, "
            f"longest {lost_s[-1]:.2f} s (limit: {LOSS_AT_MOST_S:g} s)"
        )
        if lost_s[-1] > LOSS_AT_MOST_S:
            result.wrong.append(f"{lost_s[-1]:.2f} s of {what} are missing")
    print(
        f"{result.moments} outcomes of power failures in {options.seconds:g} s, {result.syncs} fsyncs, "
        f"{result.events} events"
    )
    for store in READERS:
        with tempfile.TemporaryDirectory() as folder:
            count, wrong = fail_while_writing(store, Path(folder), others=options.moments, seed=options.seed)
        print(f"{store}: {count} outcomes, {len(wrong)} with a broken guarantee")
        result.wrong += wrong
    for line in result.wrong:
        print(f"  {line}")
    return int(bool(result.wrong))


if __name__ == "__main__":
    sys.exit(main())
