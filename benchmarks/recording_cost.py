"""Cost of recording a board at full rate, compared with `cat` of the same port to a file; sizes of the files.

Run it with `python benchmarks/recording_cost.py [--seconds N]`. The same reader reads each plate with
and without a recording in turns; the difference of its processor time, threads and all, is what recording costs. Exit
code 1 when that is more than 3 % of a core for quartz16, or when a file misses an event.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import tty
from dataclasses import dataclass
from pathlib import Path

from emulated_board import emulated_board

from resonator_daemon.links.table import parse_link
from resonator_daemon.plate import load_plate
from resonator_daemon.recording.file_series import Series
from resonator_daemon.recording.reader import Origin
from resonator_daemon.recording.switch import RecordingSwitch
from resonator_daemon.session.board_reader import BoardReader
from resonator_daemon.session.link_events import Received, WireEvent

MOST_PERCENT = 3.0
_TURNS = 4  # of each kind
_HOUR_S = 3600.0
_GIVE_UP_S = 30.0


@dataclass
class Turn:
    """Processor time in percent of a core, and what the file came to."""

    cpu_percent: float
    file_bytes_per_s: float = 0.0
    link_bytes_per_s: float = 0.0
    events_missing: int = 0


def in_turns(plate_name: str, seconds: float, folder: Path) -> tuple[list[Turn], list[Turn]]:
    """Return turns without and with a recording, of one reader that goes on."""
    plate = load_plate(plate_name)
    switch = RecordingSwitch()
    arrived = threading.Event()
    without, with_recording = [], []
    with emulated_board(plate_name, folder) as (link, _):
        reader = BoardReader(parse_link(link), plate, arrived.set, step_frames=(64,), on_event=switch.put)
        reader.start()
        deadline_s = time.monotonic() + _GIVE_UP_S
        while reader.counters().frames == 0 and time.monotonic() < deadline_s:
            _read(reader, arrived, 0.2)
        for number in range(_TURNS):
            without.append(_read(reader, arrived, seconds))
            switch.start(Series(folder, f"turn{number}"), Origin(plate, link))
            turn = _read(reader, arrived, seconds)
            summary = switch.stop()
            assert summary is not None  # noqa: S101 - it was started
            turn.file_bytes_per_s = summary.all_bytes / summary.seconds
            turn.events_missing = summary.events_missing
            with_recording.append(turn)
            summary.file.unlink()
        reader.stop()
    return without, with_recording


def _read(reader: BoardReader, arrived: threading.Event, seconds: float) -> Turn:
    begun_s, begun_cpu_s, begun_bytes = time.monotonic(), _cpu_s(), reader.counters().bytes_received
    while time.monotonic() - begun_s < seconds:
        arrived.wait(0.2)
        arrived.clear()
        reader.pop_arrivals()
    passed_s = time.monotonic() - begun_s
    received = reader.counters().bytes_received - begun_bytes
    return Turn(100 * (_cpu_s() - begun_cpu_s) / passed_s, link_bytes_per_s=received / passed_s)


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def cat_percent(seconds: float, folder: Path) -> float:
    """Return the processor time of `cat` in percent of a core, while the bytes of a board come by a terminal."""
    pieces: list[Received] = []

    def keep(event: WireEvent) -> None:
        if isinstance(event, Received):
            pieces.append(event)

    with emulated_board("quartz16", folder) as (link, _):
        arrived = threading.Event()
        reader = BoardReader(parse_link(link), load_plate("quartz16"), arrived.set, step_frames=(64,), on_event=keep)
        reader.start()
        _read(reader, arrived, seconds)
        reader.stop()
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with (folder / "copied").open("wb") as target:
        process = subprocess.Popen(["cat", os.ttyname(theirs)], stdout=target)
        ahead_ns = time.monotonic_ns() - pieces[0].now.monotonic_ns
        for piece in pieces:
            time.sleep(max(0, piece.now.monotonic_ns + ahead_ns - time.monotonic_ns()) * 1e-9)
            os.write(ours, piece.data)
        passed_s = (time.monotonic_ns() - ahead_ns - pieces[0].now.monotonic_ns) * 1e-9
        process.kill()
        process.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    os.close(ours)
    os.close(theirs)
    return 100 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / passed_s


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=3.0, help="of each turn")
    seconds = parser.parse_args().seconds
    wrong = False
    for plate in ("quartz16", "skin32"):
        with tempfile.TemporaryDirectory() as folder:
            without, recorded = in_turns(plate, seconds, Path(folder))
        costs = [one.cpu_percent - other.cpu_percent for one, other in zip(recorded, without, strict=True)]
        cost = statistics.median(costs)
        missing = sum(turn.events_missing for turn in recorded)
        file_mb = statistics.median(turn.file_bytes_per_s for turn in recorded) * _HOUR_S / 1e6
        link_mb = statistics.median(turn.link_bytes_per_s for turn in recorded) * _HOUR_S / 1e6
        print(
            f"{plate}: recording costs {cost:.1f} % of a core ({min(costs):.1f} to {max(costs):.1f} in {_TURNS} turns "
            f"of {seconds:g} s; reading alone {statistics.median(turn.cpu_percent for turn in without):.1f} %); "
            f"{file_mb:.0f} MB an hour, of {link_mb:.0f} MB on the link; {missing} events missing"
        )
        wrong |= missing > 0 or (plate == "quartz16" and cost > MOST_PERCENT)
    with tempfile.TemporaryDirectory() as folder:
        print(f"quartz16: `cat` of the same bytes to a file costs {cat_percent(2 * seconds, Path(folder)):.1f} %")
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
