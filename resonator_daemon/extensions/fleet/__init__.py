"""Decode recordings again, with another calibration, prior or decoder, to Parquet partitioned by plate and day.

Chunks of about a minute are decoded independently, by this process or the workers of a Dask cluster. A chunk that is
done is not decoded again: repeat an interrupted command to continue it.

Example: resonatord decode-recordings 'runs/*.mcap' --output decoded --plate calibrated.toml --workers 4
"""

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from resonator_daemon.base.errors import ConfigurationError, DifferenceError, ExitCode, UsageError
from resonator_daemon.base.host.text import print_note
from resonator_daemon.tools.command_line import number, print_json, whole_number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "patterns", nargs="+", metavar="PATTERN", help="recordings, as 'runs/*.mcap', or directories; also as URLs"
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="directory of the results")
    parser.add_argument("--plate", metavar="NAME|FILE", help="plate file, instead of the one in each recording")
    parser.add_argument(
        "--settings",
        type=Path,
        metavar="FILE",
        help="TOML with the tables [measurement] and [decoding], instead of those in each recording",
    )
    parser.add_argument(
        "--topics", metavar="A,B", help="topics to write, such as contacts,contacts/event (default: all)"
    )
    parser.add_argument("--scheduler", metavar="URL", help="scheduler of a Dask cluster, such as tcp://host:8786")
    parser.add_argument(
        "--workers",
        type=whole_number(1, 1024),
        metavar="N",
        help="processes on this computer (default: 1, which needs no Dask)",
    )
    parser.add_argument(
        "--chunk-seconds",
        type=number(1.0, 1e6),
        default=60.0,
        metavar="N",
        help="least length of a chunk (default: 60)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.base.host.signals import interruptible
    from resonator_daemon.base.plate import load_plate
    from resonator_daemon.board.config.values import load_settings_text, plate_text
    from resonator_daemon.extensions.fleet.chunks import Job, recordings_of
    from resonator_daemon.extensions.fleet.redecoding import chosen_topics, decode_all

    logging.getLogger().setLevel(logging.ERROR)  # differences are part of the result
    if arguments.scheduler is not None and arguments.workers is not None:
        raise UsageError("--workers are processes on this computer; a cluster with --scheduler has its own")
    settings = _text(arguments.settings)
    if settings is not None:
        load_settings_text(settings, arguments.settings)  # errors are reported before decoding begins
    plate = plate_text(load_plate(arguments.plate)) if arguments.plate is not None else None
    topics = chosen_topics(arguments.topics)
    # Workers may run in other directories.
    job = Job(arguments.output.absolute(), topics, plate, settings, arguments.chunk_seconds)
    with interruptible("complete chunks are kept; repeat the command to continue"):
        paths = recordings_of(arguments.patterns)
        progress = not arguments.json
        result, wrong = decode_all(paths, job, arguments.scheduler, arguments.workers or 1, show_progress=progress)
    if not arguments.json:
        _print(result, topics if arguments.topics is not None else ())
    if wrong:
        raise DifferenceError(*wrong, partial_result=result)
    if arguments.json:
        print_json({"verb": "decode-recordings", "ok": True, **result})
    return ExitCode.DONE


def _text(path: Path | None) -> str | None:
    if path is None:
        return None
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"--settings {path} cannot be read: {error}") from error


def _print(result: dict[str, Any], named_topics: Sequence[str]) -> None:
    before = f" ({result['chunks_done_before']} of an earlier run)" if result["chunks_done_before"] else ""
    print_note(f"recordings: {result['recordings']}, chunks: {result['chunks']}{before}, frames: {result['frames']}")
    print_note(f"{result['output']}: {result['files']} files, {result['file_bytes'] / 1e6:.1f} MB")
    for topic in named_topics:
        if not result["rows"][topic]:
            print_note(f"{topic}: no rows")
