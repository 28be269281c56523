"""Copy what is intact of a recording that was cut off or damaged.

Example: resonatord repair run.mcap
"""

import argparse
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.base.host.text import print_note
from resonator_daemon.tools.command_line import finish

if TYPE_CHECKING:
    from resonator_daemon.board.recording.repair import RepairResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="stays as it is")
    parser.add_argument("--output", type=Path, metavar="FILE", help="the file to make (default: FILE-repaired.mcap)")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.base.host.signals import interruptible
    from resonator_daemon.board.recording.repair import repair

    path: Path = arguments.file
    copy = arguments.output or path.parent / f"{path.stem}-repaired.mcap"
    with interruptible("no copy is made"):
        done = repair(path, copy)
    print_note(_summary(path, copy, done))
    return finish(arguments, {"output": None if done.was_whole else str(copy), **asdict(done)})


def _summary(path: Path, copy: Path, done: "RepairResult") -> str:
    before = f"; it reports {done.events_missing_before} events missing itself" if done.events_missing_before else ""
    if done.was_whole:
        return f"{path} is complete: nothing to repair{before}"
    wrong = []
    if not done.ended:
        cut = f", and its last {done.cut_bytes} bytes are left out" if done.cut_bytes else ""
        wrong.append(f"its end is missing{cut}")
    if done.damaged_parts:
        parts = "1 damaged part is" if done.damaged_parts == 1 else f"{done.damaged_parts} damaged parts are"
        wrong.append(f"{parts} left out ({done.damaged_bytes} bytes)")
    if done.index_damaged:
        wrong.append("its index is damaged")
    wrong += [f"its attachment {name} is damaged" for name in done.damaged_attachments]
    if done.events_missing:
        wrong.append("1 event is missing" if done.events_missing == 1 else f"{done.events_missing} events are missing")
    end = f"{done.events} events"
    if done.last_event_utc_ns is not None:
        moment = datetime.fromtimestamp(done.last_event_utc_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        end += f" up to {moment}.{done.last_event_utc_ns % 10**9 // 10**6:03d}Z"
    if not done.carries_config:
        end += "; it does not carry its plate file and settings: replay it with --config FILE"
    return f"{path}: {'; '.join(wrong)}; {copy} has {end}{before}"
