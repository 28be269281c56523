"""The options of `resonatord replay`."""

import argparse
import math
from pathlib import Path
from typing import Final

DEFAULT_URL: Final = "mqtt://127.0.0.1:1883"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare everything that `replay` takes."""
    parser.add_argument("file", type=Path, nargs="?", metavar="FILE", help="a recording, as run.mcap")
    parser.add_argument("--config", type=Path, metavar="FILE", help="instead of the plate and settings it carries")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--url", metavar="URL", help=f"the broker (default: that of --config, or {DEFAULT_URL})")
    where.add_argument("--to", type=Path, metavar="FILE.jsonl", help="a line a message instead; - is stdout")
    where.add_argument("--save-case", type=Path, metavar="DIR", help="make a case for --check in a new directory")
    where.add_argument(
        "--check", type=Path, nargs="+", metavar="DIR", help="replay cases, and compare with what they expect"
    )
    parser.add_argument("--name", help="to publish under (default: the recorded one)")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument(
        "--speed", type=_speed, metavar="X|max", help="times real time (default: 1 to a broker, max to a file)"
    )
    pace.add_argument("--step", action="store_true", help="wait for Enter before each moment that has messages")
    parser.add_argument("--from", dest="start", metavar="MARK|SECONDS", help="publish nothing of what was before")
    parser.add_argument("--until", dest="end", metavar="MARK|SECONDS", help="end there")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end, and nothing else")
    parser.set_defaults(refuse=parser.error)


def check_options(options: argparse.Namespace) -> None:
    """Refuse what does not go together; ends the program with the code for usage."""
    if options.check is not None:
        _refuse_beside(options, "--check", "file", "config", "name", "speed", "step", "start", "end")
    elif options.file is None:
        options.refuse("name a recording to be replayed, as run.mcap")
    if options.save_case is not None:
        _refuse_beside(options, "--save-case", "config", "name", "speed", "step", "start", "end")
    if options.to is not None:
        _refuse_beside(options, "--to", "name")
        if options.json and str(options.to) == "-":
            options.refuse("--json and --to - both write to stdout; give one of them")


def _refuse_beside(options: argparse.Namespace, what: str, *others: str) -> None:
    names = {"file": "FILE", "start": "--from", "end": "--until"}
    for other in others:
        if getattr(options, other) not in (None, False):
            options.refuse(f"{names.get(other, f'--{other}')} does not go with {what}")


def _speed(text: str) -> float:
    """Parse to a factor; infinity: as fast as it goes."""
    if text == "max":
        return math.inf
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 1e-3 <= speed <= 1e6:
        raise argparse.ArgumentTypeError(f"{text!r} is neither max nor a number from 0.001 to 1e6")
    return speed
