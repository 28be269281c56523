"""`resonatord record` killed at random moments: every file is readable, mended by one command, and misses one flush.

Run it with `make soak`, or `python benchmarks/kill_recording.py [--runs N] [--seed N]`. Exit code 1 when a file could
not be read or mended, or missed more than what came since the last flush. One emulated quartz16 at full rate serves
all runs. What is missing is measured in recorded time: from the file's last event to the moment of the kill.
"""

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from emulated_board import emulated_board

from resonator_daemon.links.link import LinkUnavailableError
from resonator_daemon.plate import load_plate
from resonator_daemon.recording.reader import open_recording
from resonator_daemon.recording.repair import RepairError, repair

LOSS_AT_MOST_S = 1.0
RECORDED_S = 2.5  # the longest before a kill
_MADE_S = 60.0
_TURN_S = 0.005


@dataclass
class Result:
    """What was seen over all runs."""

    lost_s: list[float] = field(default_factory=list)  # of each file
    events: int = 0
    cut_bytes: int = 0
    empty: int = 0  # killed before the first flush of events
    wrong: list[str] = field(default_factory=list)


def kill_and_read(runs: int, seed: int, folder: Path, recorded_s: float = RECORDED_S) -> Result:
    """Record for at most so long, kill and read, over and over."""
    result = Result()
    moments = random.Random(seed)
    with emulated_board("quartz16", folder) as (link, _):
        config = folder / "board.toml"
        config.write_text(f'plate = "quartz16"\nlink = "{link}"\n')
        for number in range(runs):
            path = folder / f"{number}.mcap"
            killed_ns, ended = _recorded(config, path, moments.uniform(0.0, recorded_s))
            if ended:
                result.wrong.append(f"{path.name}: the recorder ended by itself: {ended}")
            else:
                _judge(path, killed_ns, result)
            path.unlink(missing_ok=True)
    return result


def _recorded(config: Path, path: Path, seconds: float) -> tuple[int, str]:
    """Record for so long since the file is there, then kill; return the monotonic time of that.

    Where the recorder had ended before, its last words follow.
    """
    command = [sys.executable, "-m", "resonator_daemon", "record", "--config", str(config), "--output", str(path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    deadline_s = time.monotonic() + _MADE_S
    while not (path.exists() and path.stat().st_size) and process.poll() is None and time.monotonic() < deadline_s:
        time.sleep(_TURN_S)
    time.sleep(seconds if process.poll() is None else 0.0)
    killed_ns = time.monotonic_ns()
    process.send_signal(signal.SIGKILL)
    _, words = process.communicate()
    if process.returncode == -signal.SIGKILL:
        return killed_ns, ""
    return killed_ns, f"exit code {process.returncode}, {' '.join(words.splitlines()[-1:])}"


def _judge(path: Path, killed_ns: int, result: Result) -> None:
    copy = path.with_suffix(".repaired.mcap")
    try:
        with open_recording(str(path), load_plate("quartz16")) as opened:
            events = list(opened.events())
        if not events:  # killed before its first flush
            result.empty += 1
            return
        done = repair(path, copy)
        with open_recording(str(copy)) as opened:
            again = list(opened.events())
            if opened.damage is not None or again != events:
                result.wrong.append(f"{path.name}: mended, it is {opened.damage}, {len(again)} of {len(events)} events")
    except (LinkUnavailableError, RepairError, OSError) as error:
        result.wrong.append(f"{path.name}: {error}")
        return
    finally:
        copy.unlink(missing_ok=True)
    result.events += len(events)
    result.cut_bytes += done.cut_bytes
    lost_s = (killed_ns - events[-1].now.monotonic_ns) * 1e-9
    result.lost_s.append(lost_s)
    if lost_s > LOSS_AT_MOST_S:
        result.wrong.append(f"{path.name}: {lost_s:.2f} s are missing")


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = kill_and_read(options.runs, options.seed, Path(folder))
    readable = options.runs - len(result.wrong)
    lost_s = sorted(result.lost_s) or [0.0]
    print(
        f"{options.runs} kills: {readable} files readable, mended and complete but for the last flush; "
        f"{result.events} events; missing before the kill: median {lost_s[len(lost_s) // 2]:.2f} s, "
        f"longest {lost_s[-1]:.2f} s (asked: at most {LOSS_AT_MOST_S:g} s); {result.cut_bytes} bytes cut off; "
        f"{result.empty} killed before their first event"
    )
    for line in result.wrong:
        print(f"  {line}")
    return int(bool(result.wrong))


if __name__ == "__main__":
    sys.exit(main())
