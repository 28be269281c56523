"""Space the tones of force sites so that no two can be mistaken for each other.

Each force site of a plate gets a code: a step of a ladder of tones, wide enough for forces, temperature, ageing, noise
and tolerances, with codes far apart for neighbours. The output has the share of mistaken touches, the required band and
the noise of forces; --output writes a plate file.

docs/explanation/codes.md explains more.
Example: resonatord plan codes --grid 4x4 --pitch-mm 5 --force-max-newton 10 --output new-plate.toml
"""

import argparse
from pathlib import Path
from typing import Any

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.tools.command_line import number, print_json, print_page, whole_number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    places = parser.add_argument_group("sites").add_mutually_exclusive_group(required=True)
    places.add_argument("--sites", type=Path, metavar="FILE.csv", help="lines of x_mm,y_mm")
    places.add_argument("--plate", metavar="NAME|FILE", help="sites, outline, sensitivities and counter of a plate")
    places.add_argument("--grid", type=_grid, metavar="NXxNY", help="as 4x4, with --pitch-mm")

    def add_number(group: Any, name: str, low: float, high: float, meaning: str, default: float | None = None) -> None:
        group.add_argument(name, type=number(low, high), default=default, metavar="X", help=meaning)

    add_number(parser, "--pitch-mm", 0.1, 1000, "from site to site of the grid")
    tones = parser.add_argument_group("tones")
    add_number(tones, "--f0-mhz", 0.1, 1000, "upper end of the ladder; the first code is one step below (default: 10)")
    add_number(tones, "--sensitivity-ppm-per-newton", -1e5, 1e5, "K of a typical site, signed (default: -6.3)")
    add_number(tones, "--sensitivity-spread", 0, 0.8, "largest relative difference from that (default: 0.3)")
    add_number(tones, "--tolerance-ppm", 0, 1e4, "how far a tone may lie from its code (default: 20)", 20.0)
    add_number(tones, "--pull-ppm", 0, 1e4, "how far a corner may pull a tone (default: 25)", 25.0)
    add_number(tones, "--step-ppm", 0.1, 1e5, "from code to code (default: what the guard band needs)")
    add_number(tones, "--band-ppm", 10, 1e5, "in which modes are trapped, pilot included (default: 15000)", 15000.0)
    use = parser.add_argument_group("use")
    add_number(use, "--force-max-newton", 1e-3, 1e4, "largest force (default: 10)")
    add_number(use, "--temperature-span-kelvin", 0.1, 300, "from the coldest to the warmest (default: 20)")
    add_number(use, "--ageing-ppm", 0, 1e4, "of one site against another (default: 2)", 2.0)
    counter = parser.add_argument_group("counter")
    add_number(counter, "--counter-tick-ns", 1e-3, 1000, "of its clock (default: 1)")
    add_number(counter, "--stamps-per-s", 1e3, 1e9, "of one channel (default: 1e7)", 1e7)
    add_number(counter, "--window-ms", 0.1, 1000, "of one force (default: 10)", 10.0)
    add_number(counter, "--frame-rate-hz", 1, 1e5, "of the board (default: 1000)")
    result = parser.add_argument_group("result")
    add_number(result, "--touches", 100, 1e6, "to simulate (default: 20000)", 20000)
    result.add_argument(
        "--seed", type=whole_number(0, 10**18), default=0, metavar="N", help="of all that is random (default: 0)"
    )
    result.add_argument("--accept-overlap", action="store_true", help="accept codes that overlap")
    result.add_argument("--output", type=Path, metavar="FILE", help="write a plate file, which must be new")
    result.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print the plan, and write the plate file where the plan can be fulfilled."""
    from resonator_daemon.extensions.planning.code_plan import PlanRefusedError, plan_codes
    from resonator_daemon.tools.calibration.plate_file import write_plate_file

    plan = plan_codes(arguments)
    if not arguments.json:
        print_page(plan)
    if plan.refused:
        raise PlanRefusedError(*plan.refused, partial_result=plan.as_json())
    if arguments.output is not None:
        write_plate_file(plan.plate_file, arguments.output)
    if arguments.json:
        print_json(plan.as_json())
    return ExitCode.DONE


def _grid(text: str) -> tuple[int, int]:
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdecimal() and 1 <= int(part[:6]) <= 1000 for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is not NXxNY, columns and rows from 1 to 1000, as 4x4")
    return int(parts[0]), int(parts[1])
