"""Emulate a plate and its board, on a pseudo-terminal, TCP or USB, until stopped.

Example: resonatord emulate --plate quartz16 --pty /tmp/board
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from resonator_daemon.base.errors import ExitCode, UsageError, UserError, reason_of
from resonator_daemon.tools.command_line import check_plate_name, host_and_port, options_of, positive, whole_number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plate", required=True, metavar="NAME|FILE", help="a shipped plate or a plate file")
    link = parser.add_mutually_exclusive_group(required=True)
    link.add_argument("--pty", type=Path, metavar="LINKPATH", help="symbolic link to keep pointing at the terminal")
    link.add_argument("--tcp", type=host_and_port, metavar="HOST:PORT", help="where to listen; port 0 picks one")
    link.add_argument(
        "--usb", action="store_true", help="an emulated USB device, for programs that are started as it is printed"
    )
    parser.add_argument(
        "--scenario", metavar="NAME|FILE", help="what touches the plate (default: by plate; still with --control)"
    )
    parser.add_argument(
        "--control", type=Path, metavar="PATH", help="local socket at which programs press the plate, in JSON lines"
    )
    parser.add_argument(
        "--scenario-schema", action=_PrintScenarioSchema, nargs=0, help="print the JSON Schema of scenario files"
    )
    parser.add_argument("--truth", type=Path, metavar="FILE.jsonl", help="write what is true, a line a frame")
    parser.add_argument(
        "--faults",
        default="",
        metavar="SPEC",
        help="besides the scenario's faults, as bit_error_rate=1e-5,unplug_at_s=10,unplug_for_s=3; "
        "docs/reference/emulator.md lists all",
    )
    parser.add_argument(
        "--world",
        default="",
        metavar="SPEC",
        help="how the emulated plate differs from its file, such as depth=1.05,dead=p_n@417; keys are in "
        "docs/reference/emulator.md",
    )
    parser.add_argument(
        "--counter",
        choices=("sums", "stamps"),
        default="sums",
        help="of a single-tone plate: sums in closed form, or of every time stamp, which is slow (default: sums)",
    )
    parser.add_argument(
        "--seed", type=whole_number(0, 10**18), help="of all that is random (default: the scenario's, or 0)"
    )
    parser.add_argument(
        "--frame-rate-hz",
        type=positive,
        metavar="HZ",
        help="frames a second that the board offers; the daemon's plate file must have the same in [counter] "
        "(default: the daemon chooses, by its plate file)",
    )
    parser.add_argument("--speed", type=positive, default=1.0, metavar="X", help="times real time (default: 1)")
    parser.add_argument("--json", action="store_true", help="print link and counters as JSON lines on stdout")


def run(arguments: argparse.Namespace) -> ExitCode:
    try:
        from simulators.emulator import EmulatorOptions
        from simulators.emulator import run as emulate
        from simulators.faults import parse_faults

        check_plate_name(arguments.plate)
        emulate(options_of(EmulatorOptions, arguments, faults=parse_faults(arguments.faults)))
    except ValueError as error:
        raise UsageError(*str(error).split("\n")) from error  # a line for each mistake
    except BrokenPipeError:  # the reader of stdout has left
        raise
    except OSError as error:
        raise UserError(reason_of(error)) from error
    return ExitCode.DONE


class _PrintScenarioSchema(argparse.Action):
    """Like --help: prints and exits, whatever else is given or missing."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from simulators.scenario_schema import scenario_schema

        sys.stdout.write(json.dumps(scenario_schema()) + "\n")
        sys.stdout.flush()
        parser.exit()
