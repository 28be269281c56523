"""Convert recordings to tables (Parquet, CSV) or to MCAP for viewers, also for ROS 2.

Example: resonatord export run.mcap --output run.parquet
"""

import argparse
from pathlib import Path

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.base.host.text import print_note
from resonator_daemon.tools.command_line import add_recording_options, finish, named_recordings
from resonator_daemon.tools.export import format_class, formats


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "files",
        type=Path,
        nargs="+",
        metavar="FILE|DIR",
        help="recordings, as run.mcap, or their directories, as one",
    )
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="new file, as view.mcap; of .csv and .parquet one for each topic, as out-forces.csv for out.csv, or OUT "
        "itself where --topics has one",
    )
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--format", choices=formats(), help="default: by the ending of OUT")
    how.add_argument(
        "--ros2",
        dest="format",
        action="store_const",
        const="ros2",
        help="MCAP with messages of ROS 2, ends in .mcap",
    )
    parser.add_argument("--topics", metavar="A,B", help="as forces,contacts/event (default: all that the format takes)")
    add_recording_options(parser, "leave out what was before")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.base.host.files import takes_a_stream
    from resonator_daemon.base.host.signals import interruptible
    from resonator_daemon.board.config import load_config
    from resonator_daemon.tools.export.run import export, make_target, recordings_in

    target = make_target(arguments.output, arguments.format, arguments.topics)
    kept = format_class(target.form).kept or "what was written is removed"
    left = "a part of it was written" if takes_a_stream(target.output) else kept
    with interruptible(left), named_recordings():
        config = load_config(arguments.config) if arguments.config is not None else None
        paths, progress = recordings_in(arguments.files), not arguments.json
        result, wrong = export(paths, target, config, arguments.start, arguments.end, show_progress=progress)
    if not arguments.json:
        for file, size_bytes in result["files"].items():
            print_note(f"{file}: {size_bytes / 1e3:.0f} kB")
        counts = ", ".join(f"{topic}: {count}" for topic, count in result["rows"].items())
        print_note(f"{result['frames']} frames of the board became {counts or 'nothing'}")
    return finish(arguments, result, wrong)
