"""Replay a recording, from its bytes to messages.

Example: resonatord replay run.mcap --speed 4
"""

import argparse
import logging
import math
import time
from pathlib import Path
from typing import Final

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.base.host.text import print_note
from resonator_daemon.tools.command_line import add_recording_options, finish, named_recordings, number, options_of

_DEFAULT_URL: Final = "mqtt://127.0.0.1:1883"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording, as run.mcap")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--url", metavar="URL", help=f"the broker (default: that of --config, or {_DEFAULT_URL})")
    where.add_argument("--to", type=Path, metavar="FILE.jsonl", help="a line a message instead; - is stdout")
    parser.add_argument("--name", help="to publish under (default: the recorded one)")
    parser.add_argument(
        "--speed", type=_speed, metavar="X|max", help="times real time (default: 1 to a broker, max to a file)"
    )
    add_recording_options(parser, "publish nothing of what was before")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    _check(arguments)
    from resonator_daemon.board.config import load_config
    from resonator_daemon.tools.replay.run import ReplayOptions, replay

    logging.getLogger().setLevel(logging.WARNING)  # connections are not logged here
    path: Path = arguments.file
    config = load_config(arguments.config) if arguments.config is not None else None
    own = {"config": config, "output": arguments.to, "url": arguments.url, "show_progress": not arguments.json}
    begun_s = time.monotonic()
    with named_recordings():
        result, wrong = replay(path, options_of(ReplayOptions, arguments, **own))
    took_s = time.monotonic() - begun_s
    speed = round(result["seconds"] / took_s, 2)
    result = {"file": str(path), **result, "took_seconds": round(took_s, 3), "speed": speed}
    if not arguments.json:
        messages = sum(result["messages"].values())
        print_note(f"{path}: {result['frames']} frames, {messages} messages in {took_s:.1f} s")
    return finish(arguments, result, [f"{path}: {sentence}" for sentence in wrong])


def _check(arguments: argparse.Namespace) -> None:
    """Raise UsageError where arguments contradict each other."""
    if arguments.to is not None:
        if arguments.name is not None:
            raise UsageError("--name does not go with --to")
        if arguments.json and str(arguments.to) == "-":
            raise UsageError("--json and --to - both write to stdout; give one of them")


def _speed(text: str) -> float:
    """Parse to a factor; infinity: as fast as it goes."""
    return math.inf if text == "max" else number(1e-3, 1e6)(text)
